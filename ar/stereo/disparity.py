"""Depth from stereo pairs: photometric alignment of the windows, matching along rows, and the error of each match.

Points are also tracked into a later image: coarse search, sub-pixel matching, forward-backward check.

Hirschmüller 2008, "Stereo processing by semiglobal matching and mutual information", IEEE Trans. Pattern Anal. Mach.
Intell. 30:328-341, gives whole pixels. Lucas, Kanade 1981, "An iterative image registration technique", Proc. IJCAI
674-679, gives the sub-pixel part, and its error from the image gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from .rectified import Rectified

# Side of the square for local normalisation of grey levels [m]: lamps differ between eyes and positions.
NORMALISATION_SIDE = 2.5e-3
NORMALISED_CONTRAST = 60.0  # Contrast after normalisation [grey level].
HALVING_CONTRAST = 6.0  # Contrast of a square at which normalisation is halved [grey level].
BLOCK_SIDE = 5  # Side of a block of semi-global matching [pixel].
SMALL_STEP = 200  # Penalty of a change of disparity by one pixel between neighbours (OpenCV's P1).
LARGE_STEP = 800  # Penalty of a larger change (OpenCV's P2).
UNIQUENESS_MARGIN = 5  # Margin by which the best match must beat the second [%].
DEPTH_RANGE = 12e-3  # Search range of depths, in front of and behind the target [m].
SUBPIXEL_SIDE = 15  # Side of the square of the subpixel match [pixel].
SUBPIXEL_CRITERIA = (15, 0.01)  # Subpixel match: maximum number of iterations, final step [pixel].
MAX_SUBPIXEL_SHIFT = 2.0  # Largest difference of the subpixel match from the whole pixel [pixel].
MAX_ROW_SHIFT = 1.0  # Largest difference of the subpixel match from its row [pixel].
MAX_ROW_DIFFERENCE = 0.7  # Median row difference of the eyes above which the calibration is of other cameras [pixel].
# Lower bound of the disparity's standard deviation [pixel], measured on rendered images: light differs between eyes.
MIN_SIGMA = 0.12
CORRELATION_FACTOR = (
    2.0  # Factor on the matching error for correlated errors within a square, measured on rendered images.
)
# Standard deviation over mean absolute value of a Gaussian: converts the mean difference of two windows.
DEVIATION_RATIO = float(np.sqrt(0.5 * np.pi))
GLARE_BRIGHTNESS = 200  # Glare: smallest brightness [grey level].
GLARE_SATURATION = 0.12  # Glare: largest saturation [share of the maximum channel].
HIDDEN_MARGIN = 3  # Glare and covered parts: margin that is also hidden [pixel].
# Smallest standard deviation in a square, noise included [grey level]: below, highlights that move over it would match.
MIN_TEXTURE = 5.0
DARK_LEVEL = 12.0  # Mean grey level of an eye's window below which the eye is dark.


@dataclass(frozen=True, eq=False)
class StereoView:
    """View of both cameras at the same time.

    Parameters
    ----------
    geometry
        Geometry of the stereo pair.
    left, right
        Windows (size, size) uint8, normalised.
    hidden
        Mask (size, size) bool of the left window: tools, glare, and too little texture.
    hidden_right
        Mask of tools and glare in the right window.
    """

    geometry: Rectified
    left: np.ndarray
    right: np.ndarray
    hidden: np.ndarray
    hidden_right: np.ndarray

    @cached_property
    def disparity(self) -> np.ndarray:
        """(size, size) float32 [pixel] to a whole pixel or better; NaN where nothing is matched."""
        reach = int(np.ceil(self.geometry.gauge / self.geometry.depth**2 * DEPTH_RANGE))
        # OpenCV takes multiples of 16.
        count = 16 * int(np.ceil(2 * reach / 16))
        matcher = cv2.StereoSGBM.create(
            -count // 2, count, BLOCK_SIDE, SMALL_STEP, LARGE_STEP, disp12MaxDiff=1, preFilterCap=63,
            uniquenessRatio=UNIQUENESS_MARGIN, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        # Otherwise the left border of the left window has no match.
        wide = [cv2.copyMakeBorder(each, 0, 0, count, count, cv2.BORDER_REPLICATE) for each in (self.left, self.right)]
        found = matcher.compute(*wide)[:, count:-count].astype(np.float32) / 16.0
        return np.where(self.hidden | (found < -count // 2), np.nan, found)

    @cached_property
    def slope(self) -> np.ndarray:
        """(size, size): sum over a point's square of the left window's squared gradient along rows, per pixel^2."""
        slope = cv2.Sobel(self.left, cv2.CV_32F, 1, 0, scale=0.125)
        return cv2.boxFilter(slope * slope, -1, (SUBPIXEL_SIDE, SUBPIXEL_SIDE), normalize=False)

    def sample(self, pixels: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return values (n,) of a field (size, size) at the pixels nearest to (n, 2); NaN or True beyond its border."""
        here = np.nan_to_num(np.round(pixels).clip(-1.0, self.geometry.size), nan=-1.0).astype(int)
        inside = np.all((here >= 0) & (here < self.geometry.size), axis=1)
        here = np.where(inside[:, None], here, 0)
        beyond = np.nan if field.dtype.kind == "f" else True
        return np.where(inside, field[here[:, 1], here[:, 0]], beyond)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with stereo depth.

    Parameters
    ----------
    which
        (k,): numbers of the requested pixels.
    points
        World points (k, 3) [m].
    sigma
        (k,) [m]: standard deviation of the depth's error; lateral errors are smaller.
    """

    which: np.ndarray
    points: np.ndarray
    sigma: np.ndarray


def compute_stereo_view(
    geometry: Rectified, left: np.ndarray, right: np.ndarray, tool: tuple[np.ndarray, np.ndarray] | None = None
) -> StereoView:
    """Build the stereo view of two images (H, W, 3) uint8; `tool` holds the masks of a tool in each, (H, W) bool.

    Raises
    ------
    ValueError
        A dark image.
    """
    windows = geometry.rectify(left, right)
    greys = [cv2.cvtColor(window, cv2.COLOR_RGB2GRAY) for window in windows]
    for grey, name in zip(greys, ("left", "right"), strict=True):
        if grey.mean() < DARK_LEVEL:
            raise ValueError(f"the {name} eye sees nothing: check its light and its cable.")
    covers = [find_glare(window) for window in windows]
    if tool is not None:
        shadows = geometry.rectify(*(mask.astype(np.uint8) for mask in tool))
        covers = [cover | (shadow > 0) for cover, shadow in zip(covers, shadows, strict=True)]
    square = 2 * int(0.5 * NORMALISATION_SIDE * geometry.focal / geometry.depth) + 1
    hidden = [grow_mask(cover, HIDDEN_MARGIN) for cover in covers]
    (one, varies), (other, _) = (equalise(*each, square) for each in zip(greys, hidden, strict=True))
    return StereoView(geometry, one, other, hidden[0] | (varies < MIN_TEXTURE), hidden[1])


def find_glare(window: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) bool of bright pixels without colour in an image (H, W, 3) uint8."""
    red, green, blue = cv2.split(window)
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    return (most >= GLARE_BRIGHTNESS) & (most - least < GLARE_SATURATION * most)


def grow_mask(mask: np.ndarray, by: int) -> np.ndarray:
    """Dilate a mask (H, W) bool by `by` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0


def equalise(grey: np.ndarray, covered: np.ndarray, square: int) -> tuple[np.ndarray, np.ndarray]:
    """Normalise grey levels (H, W) uint8 by the mean and standard deviation in a square of `square` pixels a side.

    Pixels that are covered (H, W) bool are excluded, and become grey. The standard deviation (H, W) is returned too.
    """
    part = np.where(covered, np.float32(0.0), np.float32(1.0))
    count = np.maximum(cv2.blur(part, (square, square)), np.float32(1e-3))
    level = grey.astype(np.float32)
    level = (level - cv2.blur(level * part, (square, square)) / count) * part
    # Running sums along a row may round to negative values.
    varies = cv2.sqrt(np.maximum(cv2.blur(level * level, (square, square)), np.float32(0.0)) / count)
    return np.clip(level * (NORMALISED_CONTRAST / (varies + HALVING_CONTRAST)) + 128.0, 0.0, 255.0).astype(
        np.uint8
    ), varies


def triangulate_cloud(view: StereoView, pixels: np.ndarray) -> Cloud:
    """Compute 3-D points at pixels (n, 2) of the left window that the right camera also sees.

    Raises
    ------
    ValueError
        Rows of the two images that do not correspond: cameras other than the calibrated ones.
    """
    rough = view.sample(pixels, view.disparity)
    which = np.flatnonzero(np.isfinite(rough))
    if not len(which):
        return Cloud(which, np.zeros((0, 3)), np.zeros(0))
    here, rough = pixels[which].astype(np.float32), rough[which]
    there = here - np.stack([rough, np.zeros_like(rough)], axis=1)
    there, found, apart = cv2.calcOpticalFlowPyrLK(
        view.left, view.right, here, there.astype(np.float32), winSize=(SUBPIXEL_SIDE, SUBPIXEL_SIDE), maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *SUBPIXEL_CRITERIA),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    disparity, down = (here - there).T.astype(float)
    matched = (found.ravel() > 0) & (np.abs(disparity - rough) < MAX_SUBPIXEL_SHIFT)
    rows = float(np.median(np.abs(down[matched]))) if matched.any() else 0.0
    if rows > MAX_ROW_DIFFERENCE:
        raise ValueError(f"rows of the eyes are {rows:.1f} pixels apart: calibrate the pair again.")
    matched &= (np.abs(down) < MAX_ROW_SHIFT) & ~view.sample(there, view.hidden_right)
    steep = view.sample(here, view.slope)
    apart = np.where(found.ravel() > 0, apart.ravel(), np.inf)  # not set where nothing was found
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.hypot(CORRELATION_FACTOR * DEVIATION_RATIO * apart / np.sqrt(steep), MIN_SIGMA)
    depth = view.geometry.compute_depths(disparity)
    deviation = depth**2 / view.geometry.gauge * sigma
    points = view.geometry.compute_points(here.astype(float), disparity)
    return Cloud(which[matched], points[matched], deviation[matched])


COARSE_PIXEL = 1.0 / 3000.0  # Pixel size of the coarse search [m].
HALF_TEMPLATE = 10  # Half the side of the template of the coarse search [coarse pixels].
SEARCH_RADIUS = 27  # Search radius of the coarse search [coarse pixels].
MIN_CORRELATION = 0.5  # Smallest normalised cross-correlation of a match.
FLOW_SIDE = 21  # Side of the square of the optical flow [pixel].
FLOW_LEVELS = 1  # Highest pyramid level of the optical flow.
FLOW_CRITERIA = (20, 0.01)  # Optical flow: maximum number of iterations, final step [pixel].
MAX_RETURN_DISTANCE = 1.0  # Largest distance from the start after tracking forward and back [pixel].
NEIGHBOUR_COUNT = 8  # Number of neighbours whose median motion a point is compared with.
# Largest deviation from the neighbours' median [standard deviations]; the larger of MAX_RELATIVE_DEVIATION and
# MAX_MOTION_DEVIATION applies.
MAX_RELATIVE_DEVIATION = 4.0
MAX_MOTION_DEVIATION = 0.5e-3  # Largest deviation from the neighbours' median motion [m].


def follow_pixels(before: StereoView, now: StereoView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Track the pixels (n, 2) of one left window into another; return the numbers (k,) found, and positions (k, 2).

    Both windows have the same resolution and target, so that pixels have equal size.
    """
    guess, alike = _find_coarse(before, now, pixels)
    which = np.nonzero(alike > MIN_CORRELATION)[0]
    if not len(which):
        return which, np.zeros((0, 2))
    start = pixels[which].astype(np.float32)
    there, found = _track_pixels(before.left, now.left, start, guess[which].astype(np.float32))
    back, found_back = _track_pixels(now.left, before.left, there, start)
    kept = found & found_back & (np.linalg.norm(back - start, axis=1) < MAX_RETURN_DISTANCE)
    kept &= ~now.sample(there, now.hidden)
    return which[kept], there[kept].astype(float)


def find_supported(places: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of motions (n, 3) [m] at positions (n, 3) [m] that agree with those of their neighbours."""
    if len(places) <= NEIGHBOUR_COUNT:
        return np.ones(len(places), bool)
    near = motions[np.asarray(KDTree(places).query(places, NEIGHBOUR_COUNT + 1)[1])[:, 1:]]
    middle = np.median(near, axis=1)
    spread = 1.4826 * np.median(np.linalg.norm(near - middle[:, None], axis=2), axis=1)
    return np.linalg.norm(motions - middle, axis=1) <= np.maximum(MAX_RELATIVE_DEVIATION * spread, MAX_MOTION_DEVIATION)


def _find_coarse(before: StereoView, now: StereoView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find pixels (n, 2) again to a coarse pixel, (n, 2), by template matching, with correlations (n,)."""
    size = before.geometry.size
    share = before.geometry.depth / before.geometry.focal / COARSE_PIXEL
    few = max(1, round(share * size))
    share = few / size
    small = [cv2.resize(each, (few, few), interpolation=cv2.INTER_AREA) for each in (before.left, now.left)]
    one, other = (
        cv2.copyMakeBorder(each, by, by, by, by, cv2.BORDER_REPLICATE)
        for each, by in zip(small, (HALF_TEMPLATE, HALF_TEMPLATE + SEARCH_RADIUS), strict=True)
    )
    coarse = np.nan_to_num(np.round((pixels + 0.5) * share - 0.5)).clip(0.0, few - 1.0).astype(int)
    guess, alike = np.empty(pixels.shape), np.empty(len(pixels))
    for number, (column, row) in enumerate(coarse.tolist()):
        sample = one[row : row + 2 * HALF_TEMPLATE + 1, column : column + 2 * HALF_TEMPLATE + 1]
        around = other[
            row : row + 2 * (HALF_TEMPLATE + SEARCH_RADIUS) + 1,
            column : column + 2 * (HALF_TEMPLATE + SEARCH_RADIUS) + 1,
        ]
        _, alike[number], _, best = cv2.minMaxLoc(cv2.matchTemplate(around, sample, cv2.TM_CCOEFF_NORMED))
        guess[number] = pixels[number] + (np.array(best) - SEARCH_RADIUS) / share
    return guess, alike


def _track_pixels(
    one: np.ndarray, other: np.ndarray, start: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Track pixels (n, 2) float32 of a window into another from a guess (n, 2); return positions, success (n,)."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *FLOW_CRITERIA)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, start, guess.copy(), winSize=(FLOW_SIDE, FLOW_SIDE), maxLevel=FLOW_LEVELS, criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found.ravel() > 0

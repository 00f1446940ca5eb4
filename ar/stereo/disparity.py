"""Depth from stereo pairs: contrast normalisation, matching along rows, and the error of each match.

Points are also tracked into a later image: coarse search, subpixel matching, forward-backward check.

Whole-pixel disparities are from Hirschmüller 2008, "Stereo processing by semiglobal matching and mutual information",
IEEE Trans. Pattern Anal. Mach. Intell. 30:328-341. The subpixel part, and its error from the image gradient, are from
Lucas, Kanade 1981, "An iterative image registration technique", Proc. IJCAI 674-679.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from .rectified import RectifiedPair

# Standard deviation over mean absolute value of a Gaussian: converts the mean difference of two windows.
DEVIATION_RATIO = float(np.sqrt(0.5 * np.pi))


@dataclass(frozen=True)
class StereoSettings:
    """Settings of `compute_stereo_view` and `triangulate_cloud`."""

    # Side of the square for local normalisation of grey levels [m], as light differs between eyes and positions.
    normalisation_side: float = 2.5e-3
    normalised_contrast: float = 60.0  # Contrast after normalisation [grey level].
    halving_contrast: float = 6.0  # Contrast of a square at which normalisation is halved [grey level].
    block_side: int = 5  # Side of a block of semi-global matching [pixel].
    small_step: int = 200  # Penalty of a change of disparity by one pixel between neighbours (OpenCV's P1).
    large_step: int = 800  # Penalty of a larger change (OpenCV's P2).
    uniqueness_margin: int = 5  # Margin by which the best match must beat the second [%].
    depth_range: float = 12e-3  # Search range of depths, in front of and behind the target [m].
    subpixel_side: int = 15  # Side of the square of the subpixel match [pixel].
    # Subpixel match: maximum number of iterations, final step [pixel].
    subpixel_criteria: tuple[int, float] = (15, 0.01)
    max_subpixel_shift: float = 2.0  # Largest difference of the subpixel match from the whole pixel [pixel].
    max_row_shift: float = 1.0  # Largest difference of the subpixel match from its row [pixel].
    # Median row difference of the eyes above which the calibration does not fit the cameras [pixel].
    max_row_difference: float = 0.7
    # Lower bound of the disparity's standard deviation [pixel], from rendered images: light differs between eyes.
    min_sigma: float = 0.12
    # Factor on the matching error for correlated errors within a square, measured on rendered images.
    correlation_factor: float = 2.0
    glare_brightness: int = 200  # Glare: smallest brightness [grey level].
    glare_saturation: float = 0.12  # Glare: largest saturation [share of the maximum channel].
    hidden_margin: int = 3  # Margin round glare and tools that is also excluded [pixel].
    # Smallest standard deviation in a square, noise included [grey level]; below it, moving highlights would match.
    min_texture: float = 5.0
    dark_level: float = 12.0  # Mean grey level of an eye's window below which the eye is dark.


@dataclass(frozen=True, eq=False)
class StereoView:
    """Rectified windows of both cameras at the same time, and their disparity.

    Parameters
    ----------
    geometry
        Geometry of the rectified stereo pair.
    left, right
        Windows (size, size) uint8 with normalised contrast.
    invalid
        Mask (size, size) bool of the left window's pixels with tools, glare, or too little texture.
    invalid_right
        Mask (size, size) bool of the right window's pixels with tools or glare.
    settings
        Settings of the matching.
    """

    geometry: RectifiedPair
    left: np.ndarray
    right: np.ndarray
    invalid: np.ndarray
    invalid_right: np.ndarray
    settings: StereoSettings = StereoSettings()

    @cached_property
    def disparity(self) -> np.ndarray:
        """Disparity (size, size) float32 [pixel], accurate to a pixel or better; NaN without a match."""
        settings = self.settings
        reach = int(np.ceil(self.geometry.depth_disparity / self.geometry.depth**2 * settings.depth_range))
        # OpenCV takes multiples of 16.
        count = 16 * int(np.ceil(2 * reach / 16))
        matcher = cv2.StereoSGBM.create(
            -count // 2, count, settings.block_side, settings.small_step, settings.large_step, disp12MaxDiff=1,
            preFilterCap=63, uniquenessRatio=settings.uniqueness_margin, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        # Otherwise the left border of the left window has no match.
        wide = [cv2.copyMakeBorder(each, 0, 0, count, count, cv2.BORDER_REPLICATE) for each in (self.left, self.right)]
        found = matcher.compute(*wide)[:, count:-count].astype(np.float32) / 16.0
        return np.where(self.invalid | (found < -count // 2), np.nan, found)

    @cached_property
    def slope(self) -> np.ndarray:
        """Squared gradient (size, size) of the left window along rows, summed in a square round each pixel."""
        slope = cv2.Sobel(self.left, cv2.CV_32F, 1, 0, scale=0.125)
        return cv2.boxFilter(slope * slope, -1, 2 * (self.settings.subpixel_side,), normalize=False)

    def sample_field(self, pixels: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return values (n,) of a field (size, size) at the pixels nearest to `pixels` (n, 2); NaN or True outside."""
        here = np.nan_to_num(np.round(pixels).clip(-1.0, self.geometry.size), nan=-1.0).astype(int)
        inside = np.all((here >= 0) & (here < self.geometry.size), axis=1)
        here = np.where(inside[:, None], here, 0)
        beyond = np.nan if field.dtype.kind == "f" else True
        return np.where(inside, field[here[:, 1], here[:, 0]], beyond)


@dataclass(frozen=True, eq=False)
class StereoCloud:
    """Points with depth from stereo, and the error of the depth.

    Parameters
    ----------
    indices
        Indices (k,) of the points among the requested pixels.
    points
        World points (k, 3) [m].
    sigma
        Standard deviation (k,) [m] of each depth; lateral errors are smaller.
    """

    indices: np.ndarray
    points: np.ndarray
    sigma: np.ndarray


def compute_stereo_view(
    geometry: RectifiedPair, left: np.ndarray, right: np.ndarray,
    tool_masks: tuple[np.ndarray, np.ndarray] | None = None, settings: StereoSettings = StereoSettings(),
) -> StereoView:  # fmt: skip
    """Build the stereo view of images (H, W, 3) uint8; `tool_masks` are masks (H, W) bool of tools, one per image.

    Raises
    ------
    ValueError
        An image is dark.
    """
    windows = geometry.rectify(left, right)
    greys = [cv2.cvtColor(window, cv2.COLOR_RGB2GRAY) for window in windows]
    for grey, name in zip(greys, ("left", "right"), strict=True):
        if grey.mean() < settings.dark_level:
            raise ValueError(f"the {name} eye sees nothing: check its light and its cable.")
    covers = [find_glare(window, settings) for window in windows]
    if tool_masks is not None:
        shadows = geometry.rectify(*(mask.astype(np.uint8) for mask in tool_masks))
        covers = [cover | (shadow > 0) for cover, shadow in zip(covers, shadows, strict=True)]
    square = 2 * int(0.5 * settings.normalisation_side * geometry.focal / geometry.depth) + 1
    hidden = [grow_mask(cover, settings.hidden_margin) for cover in covers]
    (one, varies), (other, _) = (equalise_contrast(*each, square, settings) for each in zip(greys, hidden, strict=True))
    return StereoView(geometry, one, other, hidden[0] | (varies < settings.min_texture), hidden[1], settings)


def find_glare(window: np.ndarray, settings: StereoSettings) -> np.ndarray:
    """Return the mask (H, W) bool of bright, colourless pixels in an image (H, W, 3) uint8."""
    red, green, blue = cv2.split(window)
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    return (most >= settings.glare_brightness) & (most - least < settings.glare_saturation * most)


def grow_mask(mask: np.ndarray, margin: int) -> np.ndarray:
    """Return the mask (H, W) bool dilated by `margin` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0


def equalise_contrast(
    grey: np.ndarray, mask: np.ndarray, window_size: int, settings: StereoSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Normalise grey levels (H, W) uint8 by mean and standard deviation in a square of side `window_size` [pixel].

    Pixels in `mask` (H, W) bool are excluded, and become grey. Return the image and the standard deviation (H, W).
    """
    part = np.where(mask, np.float32(0.0), np.float32(1.0))
    count = np.maximum(cv2.blur(part, (window_size, window_size)), np.float32(1e-3))
    level = grey.astype(np.float32)
    level = (level - cv2.blur(level * part, (window_size, window_size)) / count) * part
    # Running sums along a row may round to negative values.
    varies = cv2.sqrt(np.maximum(cv2.blur(level * level, (window_size, window_size)), np.float32(0.0)) / count)
    level *= settings.normalised_contrast / (varies + settings.halving_contrast)
    return np.clip(level + 128.0, 0.0, 255.0).astype(np.uint8), varies


def triangulate_cloud(view: StereoView, pixels: np.ndarray) -> StereoCloud:
    """Compute world points at pixels (n, 2) of the left window, as far as the right camera sees these points.

    Raises
    ------
    ValueError
        Rows of the two windows do not correspond, so the cameras are not the calibrated ones.
    """
    rough, settings = view.sample_field(pixels, view.disparity), view.settings
    which = np.flatnonzero(np.isfinite(rough))
    if not len(which):
        return StereoCloud(which, np.zeros((0, 3)), np.zeros(0))
    here, rough = pixels[which].astype(np.float32), rough[which]
    there = here - np.stack([rough, np.zeros_like(rough)], axis=1)
    there, found, apart = cv2.calcOpticalFlowPyrLK(
        view.left, view.right, here, there.astype(np.float32), winSize=2 * (settings.subpixel_side,), maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *settings.subpixel_criteria),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    disparity, down = (here - there).T.astype(float)
    matched = (found.ravel() > 0) & (np.abs(disparity - rough) < settings.max_subpixel_shift)
    rows = float(np.median(np.abs(down[matched]))) if matched.any() else 0.0
    if rows > settings.max_row_difference:
        raise ValueError(f"rows of the eyes are {rows:.1f} pixels apart: calibrate the pair again.")
    matched &= (np.abs(down) < settings.max_row_shift) & ~view.sample_field(there, view.invalid_right)
    steep = view.sample_field(here, view.slope)
    apart = np.where(found.ravel() > 0, apart.ravel(), np.inf)  # not set where nothing was found
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.hypot(settings.correlation_factor * DEVIATION_RATIO * apart / np.sqrt(steep), settings.min_sigma)
    depth = view.geometry.compute_depths(disparity)
    deviation = depth**2 / view.geometry.depth_disparity * sigma
    points = view.geometry.compute_points(here.astype(float), disparity)
    return StereoCloud(which[matched], points[matched], deviation[matched])


@dataclass(frozen=True)
class FlowSettings:
    """Settings of `track_pixels` and `find_consistent_motions`."""

    coarse_pixel: float = 1.0 / 3000.0  # Pixel size of the coarse search [m].
    half_template: int = 10  # Half the side of the template of the coarse search [coarse pixels].
    search_radius: int = 27  # Search radius of the coarse search [coarse pixels].
    min_correlation: float = 0.5  # Smallest normalised cross-correlation of a match.
    flow_side: int = 21  # Side of the square of the optical flow [pixel].
    flow_levels: int = 1  # Highest pyramid level of the optical flow.
    flow_criteria: tuple[int, float] = (20, 0.01)  # Optical flow: maximum number of iterations, final step [pixel].
    max_return_distance: float = 1.0  # Largest distance from the start after tracking forward and back [pixel].
    neighbour_count: int = 8  # Number of neighbours whose median motion a point is compared with.
    max_relative_deviation: float = 4.0  # Largest deviation from the neighbours' median [standard deviations].
    # Largest deviation from the neighbours' median motion [m], if larger than by `max_relative_deviation`.
    max_motion_deviation: float = 0.5e-3


def track_pixels(
    previous: StereoView, current: StereoView, pixels: np.ndarray, settings: FlowSettings = FlowSettings()
) -> tuple[np.ndarray, np.ndarray]:
    """Track pixels (n, 2) of one left window into another; return the indices (k,) found and their positions (k, 2).

    Both windows must have the same resolution and target, so that their pixels have equal size.
    """
    guess, alike = _match_coarse(previous, current, pixels, settings)
    which = np.nonzero(alike > settings.min_correlation)[0]
    if not len(which):
        return which, np.zeros((0, 2))
    start = pixels[which].astype(np.float32)
    there, found = _track_pixels(previous.left, current.left, start, guess[which].astype(np.float32), settings)
    back, found_back = _track_pixels(current.left, previous.left, there, start, settings)
    kept = found & found_back & (np.linalg.norm(back - start, axis=1) < settings.max_return_distance)
    kept &= ~current.sample_field(there, current.invalid)
    return which[kept], there[kept].astype(float)


def find_consistent_motions(
    positions: np.ndarray, motions: np.ndarray, settings: FlowSettings = FlowSettings()
) -> np.ndarray:
    """Return the mask (n,) of the motions (n, 3) [m] at positions (n, 3) [m] that agree with neighbouring motions."""
    if len(positions) <= settings.neighbour_count:
        return np.ones(len(positions), bool)
    near = motions[np.asarray(KDTree(positions).query(positions, settings.neighbour_count + 1)[1])[:, 1:]]
    middle = np.median(near, axis=1)
    spread = 1.4826 * np.median(np.linalg.norm(near - middle[:, None], axis=2), axis=1)
    return np.linalg.norm(motions - middle, axis=1) <= np.maximum(
        settings.max_relative_deviation * spread, settings.max_motion_deviation
    )


def _match_coarse(
    previous: StereoView, current: StereoView, pixels: np.ndarray, settings: FlowSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Find pixels (n, 2) in a later view by coarse template matching; return positions (n, 2), correlations (n,)."""
    size, half = previous.geometry.size, settings.half_template
    share = previous.geometry.depth / previous.geometry.focal / settings.coarse_pixel
    few = max(1, round(share * size))
    share = few / size
    small = [cv2.resize(each, (few, few), interpolation=cv2.INTER_AREA) for each in (previous.left, current.left)]
    one, other = (
        cv2.copyMakeBorder(each, by, by, by, by, cv2.BORDER_REPLICATE)
        for each, by in zip(small, (half, half + settings.search_radius), strict=True)
    )
    coarse = np.nan_to_num(np.round((pixels + 0.5) * share - 0.5)).clip(0.0, few - 1.0).astype(int)
    guess, alike = np.empty(pixels.shape), np.empty(len(pixels))
    for number, (column, row) in enumerate(coarse.tolist()):
        sample = one[row : row + 2 * half + 1, column : column + 2 * half + 1]
        wide = 2 * (half + settings.search_radius) + 1
        around = other[row : row + wide, column : column + wide]
        _, alike[number], _, best = cv2.minMaxLoc(cv2.matchTemplate(around, sample, cv2.TM_CCOEFF_NORMED))
        guess[number] = pixels[number] + (np.array(best) - settings.search_radius) / share
    return guess, alike


def _track_pixels(
    previous: np.ndarray, current: np.ndarray, start: np.ndarray, guess: np.ndarray, settings: FlowSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Track pixels `start` (n, 2) float32 to another window from `guess` (n, 2); return positions and success (n,)."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *settings.flow_criteria)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        previous, current, start, guess.copy(), winSize=2 * (settings.flow_side,), maxLevel=settings.flow_levels,
        criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found.ravel() > 0

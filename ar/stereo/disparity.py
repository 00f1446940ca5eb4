"""Depths from what two eyes see: the windows made alike, matched row by row, and each match with its error.

Points are followed into a later picture too: searched for coarsely, matched exactly, there and back.

Hirschmüller 2008, "Stereo processing by semiglobal matching and mutual information", IEEE Trans. Pattern Anal. Mach.
Intell. 30:328-341, finds the whole pixel. Lucas, Kanade 1981, "An iterative image registration technique", Proc. IJCAI
674-679, finds the rest, and from the texture's slope how surely.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from .rectified import Rectified

# A grey level is taken relative to a square of this side [m]: between eyes, and from place to place, lamps differ.
SQUARE = 2.5e-3
# How steep what is left gets [grey level], and what a square must vary by to be made as steep as others [grey level].
STEEP, FLAT = 60.0, 6.0
# Matching: block, penalties of small and large steps of disparity, and how much better than others a match is [%].
BLOCK, SMALL_STEP, LARGE_STEP, BETTER = 5, 200, 800, 5
# Depths that are looked for, before and behind the target [m].
DEEP = 12e-3
# Side of a point's square that is matched exactly [pixel], and how often it is moved, until by less than [pixel].
SIDE, MOVES = 15, (15, 0.01)
# An exact match may be so far from the whole pixel, and off its row [pixel].
AWAY, OFF_ROW = 2.0, 1.0
# Rows of eyes that differ by more in half of all places are those of other cameras [pixel].
ROWS_APART = 0.7
# A disparity is never known better [pixel], as light differs between eyes; errors within a square are alike, so that
# a match is so many times as far off as independent ones would make it. Both are measured on drawn pictures.
LEAST_SIGMA, ALIKE = 0.12, 2.0
# The mean size of an error of the differences of two windows is their standard deviation over this.
MEAN_SIZE = float(np.sqrt(0.5 * np.pi))
# Glare: so bright [grey level], and of so little colour [share of the brightest]; its rim is hidden too [pixel].
BRIGHT, COLOURLESS, RIM = 200, 0.12, 3
# What varies by less in its square, noise included, tells no depth: light that slides over it would [grey level].
TEXTURE = 5.0
# An eye whose window is darker sees nothing [grey level].
BLACK = 12.0


@dataclass(frozen=True, eq=False)
class StereoView:
    """What both eyes see at once.

    Parameters
    ----------
    geometry
        How the eyes stand.
    left, right
        Windows (size, size) uint8, made alike.
    hidden
        (size, size) bool, of the left window: tools, glare, and what has too little texture.
    hidden_right
        The same of tools and glare in the right window.
    """

    geometry: Rectified
    left: np.ndarray
    right: np.ndarray
    hidden: np.ndarray
    hidden_right: np.ndarray

    @cached_property
    def disparity(self) -> np.ndarray:
        """(size, size) float32 [pixel] to a whole pixel or better; NaN where nothing is matched."""
        reach = int(np.ceil(self.geometry.gauge / self.geometry.depth**2 * DEEP))
        # OpenCV takes multiples of 16.
        count = 16 * int(np.ceil(2 * reach / 16))
        matcher = cv2.StereoSGBM.create(
            -count // 2, count, BLOCK, SMALL_STEP, LARGE_STEP, disp12MaxDiff=1, preFilterCap=63,
            uniquenessRatio=BETTER, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        # Else the left border of the left window has no match.
        wide = [cv2.copyMakeBorder(each, 0, 0, count, count, cv2.BORDER_REPLICATE) for each in (self.left, self.right)]
        found = matcher.compute(*wide)[:, count:-count].astype(np.float32) / 16.0
        return np.where(self.hidden | (found < -count // 2), np.nan, found)

    @cached_property
    def slope(self) -> np.ndarray:
        """(size, size): sum over a point's square of the left window's squared slope along rows, per pixel^2."""
        slope = cv2.Sobel(self.left, cv2.CV_32F, 1, 0, scale=0.125)
        return cv2.boxFilter(slope * slope, -1, (SIDE, SIDE), normalize=False)

    def at(self, pixels: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Values (n,) of a field (size, size) at the pixels (n, 2) that are nearest; NaN or True beyond its border."""
        here = np.nan_to_num(np.round(pixels).clip(-1.0, self.geometry.size), nan=-1.0).astype(int)
        inside = np.all((here >= 0) & (here < self.geometry.size), axis=1)
        here = np.where(inside[:, None], here, 0)
        beyond = np.nan if field.dtype.kind == "f" else True
        return np.where(inside, field[here[:, 1], here[:, 0]], beyond)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Places whose depth two eyes tell.

    Parameters
    ----------
    which
        (k,): numbers of the pixels that were asked for.
    points
        (k, 3) [m] in the world.
    sigma
        (k,) [m]: standard deviation of the depth's error; to the sides it is less.
    """

    which: np.ndarray
    points: np.ndarray
    sigma: np.ndarray


def viewed(
    geometry: Rectified, left: np.ndarray, right: np.ndarray, tool: tuple[np.ndarray, np.ndarray] | None = None
) -> StereoView:
    """What two pictures (H, W, 3) uint8 show; `tool`, where a tool hides each of them, (H, W) bool each.

    Raises
    ------
    ValueError
        An eye that sees nothing.
    """
    windows = geometry.windows(left, right)
    greys = [cv2.cvtColor(window, cv2.COLOR_RGB2GRAY) for window in windows]
    for grey, name in zip(greys, ("left", "right"), strict=True):
        if grey.mean() < BLACK:
            raise ValueError(f"the {name} eye sees nothing: check its light and its cable.")
    covers = [glare(window) for window in windows]
    if tool is not None:
        shadows = geometry.windows(*(mask.astype(np.uint8) for mask in tool))
        covers = [cover | (shadow > 0) for cover, shadow in zip(covers, shadows, strict=True)]
    square = 2 * int(0.5 * SQUARE * geometry.focal / geometry.depth) + 1
    hidden = [grown(cover, RIM) for cover in covers]
    (one, varies), (other, _) = (equalised(*each, square) for each in zip(greys, hidden, strict=True))
    return StereoView(geometry, one, other, hidden[0] | (varies < TEXTURE), hidden[1])


def glare(window: np.ndarray) -> np.ndarray:
    """(H, W) bool: what is bright without colour in a picture (H, W, 3) uint8."""
    red, green, blue = cv2.split(window)
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    return (most >= BRIGHT) & (most - least < COLOURLESS * most)


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    """A mask (H, W) bool with a rim of so many pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0


def equalised(grey: np.ndarray, covered: np.ndarray, square: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels (H, W) uint8 less their mean in a square of so many pixels a side, over what they vary by there.

    What is covered (H, W) bool takes no part, and is left grey. What they vary by (H, W) is given too, as a standard
    deviation.
    """
    part = np.where(covered, np.float32(0.0), np.float32(1.0))
    count = np.maximum(cv2.blur(part, (square, square)), np.float32(1e-3))
    level = grey.astype(np.float32)
    level = (level - cv2.blur(level * part, (square, square)) / count) * part
    # Sums that run along a row may round to less than nothing.
    varies = cv2.sqrt(np.maximum(cv2.blur(level * level, (square, square)), np.float32(0.0)) / count)
    return np.clip(level * (STEEP / (varies + FLAT)) + 128.0, 0.0, 255.0).astype(np.uint8), varies


def cloud(view: StereoView, pixels: np.ndarray) -> Cloud:
    """Where what is seen at pixels (n, 2) of the left window lies, as far as the right eye sees it too.

    Raises
    ------
    ValueError
        Rows of both eyes that do not show the same: cameras other than those that were calibrated.
    """
    rough = view.at(pixels, view.disparity)
    which = np.flatnonzero(np.isfinite(rough))
    if not len(which):
        return Cloud(which, np.zeros((0, 3)), np.zeros(0))
    here, rough = pixels[which].astype(np.float32), rough[which]
    there = here - np.stack([rough, np.zeros_like(rough)], axis=1)
    there, found, apart = cv2.calcOpticalFlowPyrLK(
        view.left, view.right, here, there.astype(np.float32), winSize=(SIDE, SIDE), maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *MOVES), flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    disparity, down = (here - there).T.astype(float)
    matched = (found.ravel() > 0) & (np.abs(disparity - rough) < AWAY)
    rows = float(np.median(np.abs(down[matched]))) if matched.any() else 0.0
    if rows > ROWS_APART:
        raise ValueError(f"rows of the eyes are {rows:.1f} pixels apart: calibrate the pair again.")
    matched &= (np.abs(down) < OFF_ROW) & ~view.at(there, view.hidden_right)
    steep = view.at(here, view.slope)
    apart = np.where(found.ravel() > 0, apart.ravel(), np.inf)  # it is not set where nothing was found
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.hypot(ALIKE * MEAN_SIZE * apart / np.sqrt(steep), LEAST_SIGMA)
    depth = view.geometry.depths(disparity)
    deviation = depth**2 / view.geometry.gauge * sigma
    points = view.geometry.points(here.astype(float), disparity)
    return Cloud(which[matched], points[matched], deviation[matched])


# Pixels of the coarse search [m], half a side of what is searched for, and how far it is searched for, both in these.
COARSE, HALF, REACH = 1.0 / 3000.0, 10, 27
# How alike the two must be: normalised cross-correlation.
FLOW_ALIKE = 0.5
# Side of the square that is matched exactly [pixel], levels above it, and when its moves end.
FLOW_SIDE, FLOW_LEVELS, FLOW_MOVES = 21, 1, (20, 0.01)
# A point that is followed back ends so near to its start [pixel].
BACK = 1.0
# Neighbours of a point, and how far it may move otherwise than their median does: in their deviations, or [m].
NEIGHBOURS, DEVIATIONS, FREE = 8, 4.0, 0.5e-3


def followed(before: StereoView, now: StereoView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which (k,) of the pixels (n, 2) of one left window are found in another, and where (k, 2).

    Both windows have the same fineness and target, so that a pixel is as large.
    """
    guess, alike = _searched(before, now, pixels)
    which = np.nonzero(alike > FLOW_ALIKE)[0]
    if not len(which):
        return which, np.zeros((0, 2))
    start = pixels[which].astype(np.float32)
    there, found = _matched(before.left, now.left, start, guess[which].astype(np.float32))
    back, found_back = _matched(now.left, before.left, there, start)
    kept = found & found_back & (np.linalg.norm(back - start, axis=1) < BACK)
    kept &= ~now.at(there, now.hidden)
    return which[kept], there[kept].astype(float)


def supported(places: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """(n,) bool: which motions (n, 3) [m] at places (n, 3) [m] are like those of their neighbours."""
    if len(places) <= NEIGHBOURS:
        return np.ones(len(places), bool)
    near = motions[np.asarray(KDTree(places).query(places, NEIGHBOURS + 1)[1])[:, 1:]]
    middle = np.median(near, axis=1)
    spread = 1.4826 * np.median(np.linalg.norm(near - middle[:, None], axis=2), axis=1)
    return np.linalg.norm(motions - middle, axis=1) <= np.maximum(DEVIATIONS * spread, FREE)


def _searched(before: StereoView, now: StereoView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where (n, 2) what is about pixels (n, 2) is found again, to a coarse pixel, and how alike it is (n,)."""
    size = before.geometry.size
    share = before.geometry.depth / before.geometry.focal / COARSE
    few = max(1, round(share * size))
    share = few / size
    small = [cv2.resize(each, (few, few), interpolation=cv2.INTER_AREA) for each in (before.left, now.left)]
    one, other = (
        cv2.copyMakeBorder(each, by, by, by, by, cv2.BORDER_REPLICATE)
        for each, by in zip(small, (HALF, HALF + REACH), strict=True)
    )
    coarse = np.nan_to_num(np.round((pixels + 0.5) * share - 0.5)).clip(0.0, few - 1.0).astype(int)
    guess, alike = np.empty(pixels.shape), np.empty(len(pixels))
    for number, (column, row) in enumerate(coarse.tolist()):
        sample = one[row : row + 2 * HALF + 1, column : column + 2 * HALF + 1]
        around = other[row : row + 2 * (HALF + REACH) + 1, column : column + 2 * (HALF + REACH) + 1]
        _, alike[number], _, best = cv2.minMaxLoc(cv2.matchTemplate(around, sample, cv2.TM_CCOEFF_NORMED))
        guess[number] = pixels[number] + (np.array(best) - REACH) / share
    return guess, alike


def _matched(one: np.ndarray, other: np.ndarray, start: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where pixels (n, 2) float32 of a window are in another one, near a guess (n, 2), and whether they are (n,)."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *FLOW_MOVES)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, start, guess.copy(), winSize=(FLOW_SIDE, FLOW_SIDE), maxLevel=FLOW_LEVELS, criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found.ravel() > 0

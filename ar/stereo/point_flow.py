"""Points of a picture that are followed into a later one: searched for coarsely, matched exactly, there and back."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import KDTree

from .disparity import StereoView

# Pixels of the coarse search [m], half a side of what is searched for, and how far it is searched for, both in these.
COARSE, HALF, REACH = 1.0 / 3000.0, 10, 27
# How alike the two must be: normalised cross-correlation.
ALIKE = 0.5
# Side of the square that is matched exactly [pixel], levels above it, and when its moves end.
SIDE, LEVELS, MOVES = 21, 1, (20, 0.01)
# A point that is followed back ends so near to its start [pixel].
BACK = 1.0
# Neighbours of a point, and how far it may move otherwise than their median does: in their deviations, or [m].
NEIGHBOURS, DEVIATIONS, FREE = 8, 4.0, 0.5e-3


def followed(before: StereoView, now: StereoView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which (k,) of the pixels (n, 2) of one left window are found in another, and where (k, 2).

    Both windows have the same fineness and target, so that a pixel is as large.
    """
    guess, alike = _searched(before, now, pixels)
    which = np.nonzero(alike > ALIKE)[0]
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
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *MOVES)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, start, guess.copy(), winSize=(SIDE, SIDE), maxLevel=LEVELS, criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found.ravel() > 0

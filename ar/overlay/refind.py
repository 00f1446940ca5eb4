"""What stands in a picture, found again from its pixels alone: an outline by its colour, a line of text by its ink."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from .hud import FONT, WHITE
from .outlines import outlines

# Middles of lines have their ink's very colour, within rounding.
SAME = 2
# Of an outline's pixels this share must be near: corners and crossings of lines are the rest [%].
SHARE = 95.0
# So near to what covers it or to the picture's border an outline may be cut [pixel].
CUT = 5
# So far from a mask's rim lines may run; a share of fewer pixels says nothing [pixel].
BESIDE, FEW = 6, 60
# Room round a line of text that holds nothing of its ink: else "1.5" would be found in "11.5" [pixel].
APART = 8


def outline_gap(
    colour: np.ndarray, ink: Sequence[float], mask: np.ndarray, covered: np.ndarray, least: int = 1, gap: float = 0.0
) -> float:
    """How far the outline drawn in a picture is from the one that should be there [pixel].

    The larger of two 95th percentiles: from pixels of the ink to the true outline, and from the true outline to them.
    0 where nothing of the outline can be seen and nothing is drawn, infinite where only one of the two is there.

    Parameters
    ----------
    colour, ink
        The picture (H, W, 3) uint8, and the colour (3,) in 0 .. 255 that outlines are drawn in.
    mask
        (H, W) bool: the true silhouette.
    covered
        (H, W) bool: what lies in front of the overlay.
    least
        Fewer pixels than this are nothing, and each is held against all of the other outline: what can be seen of a
        broken line may be a gap.
    gap
        How long the gaps of a broken line are [pixel]: the true outline may be half of that from it.
    """
    found = of_ink(colour, ink)
    true = np.zeros(mask.shape, np.uint8)
    for outline in outlines(mask):
        cv2.polylines(true, [outline], True, (1,))
    shut = cv2.dilate(np.pad(covered, 1, constant_values=True).astype(np.uint8), np.ones((2 * CUT + 1,) * 2, np.uint8))
    seen = shut[1:-1, 1:-1] == 0
    wanted = (true > 0) & seen
    if max(np.count_nonzero(wanted), np.count_nonzero(found & seen)) < least:
        return 0.0
    there = (true > 0, found) if least > 1 else (wanted, found & seen)
    if not all(each.any() for each in there):
        return np.inf
    apart = _distance(true > 0)[found & seen], np.maximum(_distance(found)[wanted] - 0.5 * gap, 0.0)
    return float(max(np.percentile(each, SHARE) for each in apart if len(each)))


def of_ink(colour: np.ndarray, ink: Sequence[float], off: int = SAME) -> np.ndarray:
    """(H, W) bool: the pixels of a picture (H, W, 3) uint8 with an ink's colour (3,) in 0 .. 255, `off` in each."""
    low, high = (tuple(np.clip(np.rint(ink) + by, 0, 255).tolist()) for by in (-off, off))
    return cv2.inRange(np.ascontiguousarray(colour), low, high) > 0


def _distance(mask: np.ndarray) -> np.ndarray:
    """How far each pixel is from the nearest of a mask (H, W) [pixel]."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def stands(colour: np.ndarray, text: str, scale: float, ink: Sequence[float] = WHITE) -> bool:
    """Whether `hud.write` wrote just this line of text at this scale into the picture (H, W, 3) uint8, anywhere."""
    return found_at(colour, text, scale, ink) is not None


def found_at(
    colour: np.ndarray, text: str, scale: float, ink: Sequence[float] = WHITE
) -> tuple[int, int, int, int] | None:
    """Where `hud.write` wrote just this line of text: left, top, right and foot [pixel]; None where nowhere."""
    (width, above), below = cv2.getTextSize(text, FONT, scale, 1)
    blank = np.zeros((above + below + 2, width + 2 * APART, 3), np.uint8)
    cv2.putText(blank, text, (APART, above + 1), FONT, scale, tuple(ink), 1, cv2.LINE_AA)
    shape = (blank == ink).all(axis=2).astype(np.float32)
    here = np.pad(of_ink(colour, ink, 0), APART).astype(np.float32)
    if shape.shape[0] > here.shape[0] or shape.shape[1] > here.shape[1]:
        return None
    right = cv2.matchTemplate(here, shape, cv2.TM_CCORR)
    every = cv2.matchTemplate(here, np.ones_like(shape), cv2.TM_CCORR)
    count = shape.sum()
    # All of the text's pixels, and no other of its ink between them.
    places = np.argwhere((right > count - 0.5) & (every < count + 0.5))
    if not len(places):
        return None
    left, foot = int(places[0, 1]), int(places[0, 0]) + above + 1 - APART + below
    return left, foot - below - above, left + width, foot


def inked_share(colour: np.ndarray, ink: Sequence[float], mask: np.ndarray, covered: np.ndarray) -> float:
    """What share of a silhouette's outline has an ink; NaN of an outline of fewer than `FEW` pixels.

    Parameters as in `outline_gap`: near what covers it, and near the border, an outline is left out.
    """
    outline = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(outline, outlines(mask), -1, (1,))
    shut = cv2.dilate(np.pad(covered, 1, constant_values=True).astype(np.uint8), np.ones((2 * CUT + 1,) * 2, np.uint8))
    return _share(of_ink(colour, ink), (outline > 0) & (shut[1:-1, 1:-1] == 0))


def changed_share(before: np.ndarray, after: np.ndarray, where: np.ndarray) -> float:
    """What share of pixels differs between pictures (H, W, 3) uint8, in a mask (H, W) bool without its outer rim.

    NaN of fewer than `FEW` pixels.
    """
    inner = cv2.erode(where.astype(np.uint8), np.ones((2 * BESIDE + 1,) * 2, np.uint8), borderValue=0) > 0
    return _share(~of_ink(cv2.absdiff(before, after), (0, 0, 0)), inner)


def _share(found: np.ndarray, where: np.ndarray) -> float:
    return float(found[where].mean()) if np.count_nonzero(where) >= FEW else np.nan

"""Where words go in a picture: the free place that is nearest to the one where they are wanted."""

from __future__ import annotations

import cv2
import numpy as np

# So far words stay from the border, and from lines and other words [pixel].
PAD, CLEAR = 8, 6
# Places are tried at every so many pixels.
STEP = 4
# Places so far from the wish are tried before all others [pixel].
REACHES = 64, 256
# So many times as far as a place to its side a place is that lies above: lines of text go below each other.
ASIDE = 2


def free_place(taken: np.ndarray, size: tuple[int, int], wish: tuple[int, int]) -> tuple[int, int] | None:
    """Find where a box can stand, as near as can be to where it is wanted; None where there is no space.

    Parameters
    ----------
    taken
        (H, W) uint8: above 0 where nothing may stand.
    size, wish
        Width and height of the box; column and row where its upper left corner is wanted, which may lie outside the
        picture [pixel].
    """
    (height, width), (wide, tall) = taken.shape, size
    right, low = width - PAD - wide, height - PAD - tall
    if right < PAD or low < PAD:
        return None
    column, row = min(max(wish[0], PAD), right), min(max(wish[1], PAD), low)
    near = taken[row - CLEAR : row + tall + CLEAR, column - CLEAR : column + wide + CLEAR]
    if not near.any():
        return column, row
    whole = ASIDE * width + height
    for reach in (*REACHES, whole):
        # All places that may be as near as that, and what is taken round them.
        columns, rows = within(column, reach // ASIDE, right), within(row, reach, low)
        top, left = rows[0] - CLEAR, columns[0] - CLEAR
        there = taken[top : rows[-1] + tall + CLEAR, left : columns[-1] + wide + CLEAR]
        # What is taken above and left of each pixel: the box's share of it is a sum of four.
        sums = cv2.integral((there > 0).astype(np.uint8))
        up, aside = rows[:, None] - CLEAR - top, columns - CLEAR - left
        down, across = up + tall + 2 * CLEAR, aside + wide + 2 * CLEAR
        inside = sums[down, across] - sums[up, across] - sums[down, aside] + sums[up, aside]
        far = (ASIDE * (columns - column)) ** 2 + ((rows - row) ** 2)[:, None]
        best = np.where(inside == 0, far, np.inf)
        at = np.unravel_index(best.argmin(), best.shape)
        if best[at] <= reach**2:
            return int(columns[at[1]]), int(rows[at[0]])
    return None


def within(middle: int, reach: int, last: int) -> np.ndarray:
    """The tried places PAD, PAD + STEP, ... up to `last` that are at most `reach` from a middle."""
    places = np.arange(PAD, last + 1, STEP)
    return places[np.abs(places - middle) <= reach]

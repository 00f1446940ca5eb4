"""Where words go in a picture: the free place that is nearest to the one where they are wanted."""

from __future__ import annotations

import cv2
import numpy as np

# So far words stay from the border, and from lines and other words [pixel].
PAD, CLEAR = 8, 6
# Places are tried at every so many pixels.
STEP = 4
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
    columns, rows = np.arange(PAD, right + 1, STEP), np.arange(PAD, low + 1, STEP)
    # What is taken above and left of each pixel: the box's share of it is a sum of four.
    sums = cv2.integral((taken > 0).astype(np.uint8))
    top, low, left, right = rows[:, None] - CLEAR, rows[:, None] + tall + CLEAR, columns - CLEAR, columns + wide + CLEAR
    inside = sums[low, right] - sums[top, right] - sums[low, left] + sums[top, left]
    far = (ASIDE * (columns - column)) ** 2 + ((rows - row) ** 2)[:, None]
    best = np.where(inside == 0, far, np.inf)
    at = np.unravel_index(best.argmin(), best.shape)
    return (int(columns[at[1]]), int(rows[at[0]])) if np.isfinite(best[at]) else None

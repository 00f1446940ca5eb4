"""Placement of text in an image: the free place closest to the desired one."""

from __future__ import annotations

import cv2
import numpy as np

PAD = 8  # Distance of text from the image border [pixel].
CLEAR = 6  # Distance of text from lines and other text [pixel].
STEP = 4  # Grid spacing of candidate places [pixel].
REACHES = 64, 256  # Search radii around the desired place [pixel], tried in order before the whole image.
ASIDE = 2  # Weight of a sideways distance relative to a vertical one: lines of text go below each other.


def find_free_place(taken: np.ndarray, size: tuple[int, int], wish: tuple[int, int]) -> tuple[int, int] | None:
    """Find the free place for a box closest to the desired one; None if there is no space.

    Parameters
    ----------
    taken
        (H, W) uint8: above 0 where the box must not be.
    size, wish
        Width and height of the box; desired column and row of its upper left corner, which may be outside the image
        [pixel].
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
        # All places within this radius, and the taken pixels round them.
        columns, rows = list_places_within(column, reach // ASIDE, right), list_places_within(row, reach, low)
        top, left = rows[0] - CLEAR, columns[0] - CLEAR
        there = taken[top : rows[-1] + tall + CLEAR, left : columns[-1] + wide + CLEAR]
        # Integral image: the number of taken pixels in a box is a sum of four values.
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


def list_places_within(middle: int, reach: int, last: int) -> np.ndarray:
    """List the candidate places PAD, PAD + STEP, ... up to `last` that are at most `reach` from a centre."""
    places = np.arange(PAD, last + 1, STEP)
    return places[np.abs(places - middle) <= reach]

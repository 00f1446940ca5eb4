"""Placement of text in an image, at the free position closest to the desired one."""

import cv2
import numpy as np

BORDER_DISTANCE = 8  # Distance of text from the image border [pixel].
TEXT_DISTANCE = 6  # Distance of text from lines and other text [pixel].
GRID_SPACING = 4  # Grid spacing of candidate positions [pixel].
SEARCH_RADII = 64, 256  # Search radii round the desired position [pixel], tried in order before the whole image.
SIDEWAYS_WEIGHT = 2  # Weight of horizontal relative to vertical distances, so that texts are placed below each other.


def find_free_position(occupied: np.ndarray, size: tuple[int, int], desired: tuple[int, int]) -> tuple[int, int] | None:
    """Find the free position of a box that is closest to the desired one; None if there is no space.

    Parameters
    ----------
    occupied
        Mask (H, W) uint8: above 0 where the box must not be.
    size, desired
        Width and height of the box [pixel], and desired column and row of its upper left corner, which may be outside
        the image.
    """
    (height, width), (wide, tall) = occupied.shape, size
    right, low = width - BORDER_DISTANCE - wide, height - BORDER_DISTANCE - tall
    if right < BORDER_DISTANCE or low < BORDER_DISTANCE:
        return None
    column, row = min(max(desired[0], BORDER_DISTANCE), right), min(max(desired[1], BORDER_DISTANCE), low)
    near = occupied[
        row - TEXT_DISTANCE : row + tall + TEXT_DISTANCE, column - TEXT_DISTANCE : column + wide + TEXT_DISTANCE
    ]
    if not near.any():
        return column, row
    whole = SIDEWAYS_WEIGHT * width + height
    for reach in (*SEARCH_RADII, whole):
        # All places within this radius, and the taken pixels round them.
        columns, rows = (
            list_positions_within(column, reach // SIDEWAYS_WEIGHT, right),
            list_positions_within(row, reach, low),
        )
        top, left = rows[0] - TEXT_DISTANCE, columns[0] - TEXT_DISTANCE
        there = occupied[top : rows[-1] + tall + TEXT_DISTANCE, left : columns[-1] + wide + TEXT_DISTANCE]
        # Integral image: the number of taken pixels in a box is a sum of four values.
        sums = cv2.integral((there > 0).astype(np.uint8))
        up, aside = rows[:, None] - TEXT_DISTANCE - top, columns - TEXT_DISTANCE - left
        down, across = up + tall + 2 * TEXT_DISTANCE, aside + wide + 2 * TEXT_DISTANCE
        inside = sums[down, across] - sums[up, across] - sums[down, aside] + sums[up, aside]
        far = (SIDEWAYS_WEIGHT * (columns - column)) ** 2 + ((rows - row) ** 2)[:, None]
        best = np.where(inside == 0, far, np.inf)
        at = np.unravel_index(best.argmin(), best.shape)
        if best[at] <= reach**2:
            return int(columns[at[1]]), int(rows[at[0]])
    return None


def list_positions_within(centre: int, max_distance: int, last: int) -> np.ndarray:
    """List candidate positions BORDER_DISTANCE + k GRID_SPACING up to `last`, within `max_distance` of `centre`."""
    places = np.arange(BORDER_DISTANCE, last + 1, GRID_SPACING)
    return places[np.abs(places - centre) <= max_distance]

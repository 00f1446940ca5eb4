"""Free places in an image."""

import numpy as np
import pytest

from ar.overlay.text_placement import BORDER_DISTANCE, GRID_SPACING, SIDEWAYS_WEIGHT, TEXT_DISTANCE, find_free_position


@pytest.mark.parametrize("seed", range(5))
def test_free_place_is_nearest_to_the_requested_position(seed):
    """Compared with a search of all places on the same grid."""
    rng = np.random.default_rng(seed)
    taken = np.zeros((120, 160), np.uint8)
    for row, column in rng.integers(0, (120, 160), (14, 2)):
        taken[row : row + 12, column : column + 12] = 1
    size, wish = (30, 12), tuple(rng.integers(-20, 180, 2).tolist())
    there = (
        min(max(wish[0], BORDER_DISTANCE), 160 - BORDER_DISTANCE - 30),
        min(max(wish[1], BORDER_DISTANCE), 120 - BORDER_DISTANCE - 12),
    )

    def free(column, row):
        return not taken[
            row - TEXT_DISTANCE : row + 12 + TEXT_DISTANCE, column - TEXT_DISTANCE : column + 30 + TEXT_DISTANCE
        ].any()

    def far(column, row):
        return (SIDEWAYS_WEIGHT * (column - there[0])) ** 2 + (row - there[1]) ** 2

    grid = [
        (c, r)
        for r in range(BORDER_DISTANCE, 120 - BORDER_DISTANCE - 12 + 1, GRID_SPACING)
        for c in range(BORDER_DISTANCE, 160 - BORDER_DISTANCE - 30 + 1, GRID_SPACING)
    ]
    places = [place for place in grid if free(*place)]
    found = find_free_position(taken, size, wish)
    assert places and found is not None and free(*found)
    assert far(*found) == (0 if free(*there) else min(far(*place) for place in places))


def test_full_image_has_no_free_place_for_text():
    taken = np.zeros((100, 200), np.uint8)
    assert find_free_position(taken, (184, 84), (0, 0)) == (BORDER_DISTANCE, BORDER_DISTANCE)
    assert find_free_position(taken, (185, 84), (0, 0)) is None and find_free_position(taken, (20, 85), (0, 0)) is None
    taken[::10] = 1
    assert find_free_position(taken, (20, 12), (50, 50)) is None

"""Charts: what is drawn lies where it belongs, and what cannot be drawn is refused."""

import numpy as np
import pytest

from ar.chart import BOTTOM, COLOURS, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Curve, Panel, drawn


def panel(*points, marks=()):
    return Panel("title", "nodes", "seconds", (Curve("one", points),), marks)


def ink(picture, colour):
    """Rows and columns (n, 2) of the pixels of a colour, the key in the corner left out."""
    found = np.argwhere((np.abs(picture.astype(int) - colour) < 12).all(axis=-1))
    return found[(found[:, 0] > TOP + 40) | (found[:, 1] > LEFT + 60)]


def test_points_that_rise_by_a_power_lie_on_a_line():
    rows, columns = ink(drawn([panel((1e1, 1e0), (1e2, 1e1), (1e3, 1e2))]), COLOURS[0]).T
    assert columns.min() >= LEFT and columns.max() <= WIDTH - RIGHT
    assert rows.min() >= TOP and rows.max() <= HEIGHT - BOTTOM
    slope, start = np.polyfit(columns, rows, 1)
    assert slope < 0.0
    assert np.abs(rows - slope * columns - start).max() < 6.0


def test_panels_stand_side_by_side_and_are_the_same_every_time():
    one = panel((1.0, 2.0), marks=((1.5, "here"),))
    picture = drawn([one, one])
    assert picture.shape == (HEIGHT, 2 * WIDTH, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(*np.split(picture, 2, axis=1))
    np.testing.assert_array_equal(picture, drawn([one, one]))


@pytest.mark.parametrize("points", [(), ((0.0, 1.0),), ((1.0, -1.0),)])
def test_what_has_no_logarithm_is_refused(points):
    with pytest.raises(ValueError, match="positive"):
        drawn([panel(*points)])
    with pytest.raises(ValueError, match="nothing"):
        drawn([])

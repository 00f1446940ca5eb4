"""The patient's sides at the edges of a picture."""

import numpy as np
import pytest

from ar.camera import look_at
from ar.hud import bearings, marked, millimetres, towards


@pytest.mark.parametrize(
    ("direction", "letters"),
    [
        ((1.0, 0.0, 0.0), "R"),
        ((-2.0, 0.0, 0.0), "L"),
        ((0.0, 1.0, 0.0), "A"),
        ((0.0, -1.0, 0.1), "P"),
        ((0.0, 0.0, 1.0), "S"),
        ((0.0, 0.0, -1.0), "I"),
        ((0.5, 0.0, 0.8), "SR"),
        ((-0.8, 0.6, 0.1), "LA"),
    ],
)
def test_a_direction_has_the_letters_of_its_greatest_parts(direction, letters):
    assert towards(np.array(direction)) == letters


def test_what_lies_at_the_edges_follows_from_the_camera():
    """From the patient's right side, crown upwards: the face is on the right."""
    aside = look_at(np.array([0.3, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert bearings(aside.T_camera_world[:3, :3]) == {"left": "P", "right": "A", "top": "S", "bottom": "I"}
    # From above, face upwards in the picture: the patient's right is on the right; from below it is on the left.
    above = look_at(np.array([0.0, 0.0, 0.3]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    below = look_at(np.array([0.0, 0.0, -0.3]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    assert bearings(above.T_camera_world[:3, :3]) == {"left": "L", "right": "R", "top": "A", "bottom": "P"}
    assert bearings(below.T_camera_world[:3, :3]) == {"left": "R", "right": "L", "top": "A", "bottom": "P"}


def test_letters_stand_at_the_edges():
    plain = np.full((240, 320, 3), 90, np.uint8)
    turn = np.eye(3)
    letters = marked(plain, turn)
    changed = (letters != plain).any(axis=2)
    for edge in (changed[100:140, :30], changed[100:140, -30:], changed[:30, 60:100], changed[-30:, 220:260]):
        assert edge.any()
    assert not changed[40:200, 40:280].any() and (plain == 90).all()


@pytest.mark.parametrize(
    ("length", "error", "text"),
    [
        (12.34e-3, None, "12.3 mm"),
        (12.34e-3, 2.46e-3, "12.3 +- 2.5 mm"),
        (12.34e-3, 2.41e-3, "12.3 +- 2.5 mm"),  # a bound is not told too small
        (12.34e-3, 2.4e-3, "12.3 +- 2.4 mm"),
        (12.34e-3, float("nan"), "12.3 mm"),
        (0.0, 1e-6, "0.0 +- 0.1 mm"),  # nothing is known to be without error
    ],
)
def test_a_length_is_read_in_millimetres_with_what_it_may_be_off_by(length, error, text):
    assert millimetres(length, error) == text

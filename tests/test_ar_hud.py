"""Text on an image: orientation labels, panels and lengths."""

import cv2
import numpy as np
import pytest

from ar.optics.camera import look_at
from ar.overlay.hud import (
    BREAK_PATTERN,
    FONT,
    MAX_TEXT_SHIFT,
    TEXT_SCALE,
    Hideable,
    draw_orientation_labels,
    draw_text_panel,
    format_millimetres,
    name_direction,
    name_edge_directions,
    place_text,
    wrap_line,
)
from ar.overlay.outlines import find_text
from ar.overlay.text_placement import BORDER_DISTANCE


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
def test_direction_is_named_by_its_largest_components(direction, letters):
    assert name_direction(np.array(direction)) == letters


def test_edge_labels_follow_the_camera_orientation():
    """Seen from the patient's right with the crown up, the face is on the right."""
    aside = look_at(np.array([0.3, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert name_edge_directions(aside.T_camera_world[:3, :3]) == {"left": "P", "right": "A", "top": "S", "bottom": "I"}
    # From above, face upwards in the picture: the patient's right is on the right; from below it is on the left.
    above = look_at(np.array([0.0, 0.0, 0.3]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    below = look_at(np.array([0.0, 0.0, -0.3]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    assert name_edge_directions(above.T_camera_world[:3, :3]) == {"left": "L", "right": "R", "top": "A", "bottom": "P"}
    assert name_edge_directions(below.T_camera_world[:3, :3]) == {"left": "R", "right": "L", "top": "A", "bottom": "P"}


def test_orientation_labels_are_drawn_at_image_edges():
    plain = np.full((240, 320, 3), 90, np.uint8)
    turn = np.eye(3)
    letters = draw_orientation_labels(plain, turn, np.zeros(plain.shape[:2], np.uint8))
    changed = (letters != plain).any(axis=2)
    for edge in (changed[100:140, :30], changed[100:140, -30:], changed[:30, 60:100], changed[-30:, 220:260]):
        assert edge.any()
    assert not changed[40:200, 40:280].any() and (plain == 90).all()


def test_text_panel_drops_lines_that_do_not_fit():
    plain = np.full((100, 320, 3), 90, np.uint8)
    lines = ["first", "second", "third", "fourth", "fifth"]
    few = draw_text_panel(plain, lines, first_row=30)
    kept = next(
        count for count in range(1, 6) if np.array_equal(few, draw_text_panel(plain, lines[:count], first_row=30))
    )
    assert 1 < kept < 4 and (few[:30] == 90).all() and (few[-BORDER_DISTANCE:] == 90).all()


@pytest.mark.parametrize(
    ("length", "error", "text"),
    [
        (12.34e-3, None, "12.3 mm"),
        (12.34e-3, 2.46e-3, "12.3 +- 2.5 mm"),
        (12.34e-3, 2.41e-3, "12.3 +- 2.5 mm"),  # a bound is not stated too small
        (12.34e-3, 2.4e-3, "12.3 +- 2.4 mm"),
        (12.34e-3, float("nan"), "12.3 mm"),
        (0.0, 1e-6, "0.0 +- 0.1 mm"),  # nothing is known to be without error
    ],
)
def test_length_is_printed_in_millimetres_with_error(length, error, text):
    assert format_millimetres(length, error) == text


def test_orientation_label_shifts_along_its_edge():
    """A line through the top label shifts this label sideways, and no other."""
    plain = np.full((240, 320, 3), 90, np.uint8)
    taken = np.zeros(plain.shape[:2], np.uint8)
    free = draw_orientation_labels(plain, np.eye(3), taken)
    taken[:120, 70:90] = 1
    letters = draw_orientation_labels(plain, np.eye(3), taken)
    changed = (letters != plain).any(axis=2)
    assert not changed[:120, 70:90].any() and changed[:30].any()
    assert np.array_equal(letters[40:], free[40:]) and taken.sum() == 2400
    # Where its edge has no room a letter is left out: at another it would be wrong.
    taken[:40] = 1
    letters = draw_orientation_labels(plain, np.eye(3), taken)
    assert np.array_equal(letters[:40], plain[:40]) and np.array_equal(letters[60:], free[60:])


def test_optional_labels_without_room_are_dropped():
    colour, taken = np.zeros((100, 200, 3), np.uint8), np.zeros((100, 200), np.uint8)
    place_text(colour, taken, ["first"], (0, 100))
    (low,) = np.nonzero(taken.any(axis=1))[0][[-1]]
    place_text(colour, taken, ["second", "and its next line"], (0, 100))
    assert low == 100 - BORDER_DISTANCE - 1 and np.nonzero(taken.any(axis=1))[0][0] < low - 40 and colour.any()
    # What is written is inside what is taken, but for the halo.
    assert not colour[cv2.dilate(taken, np.ones((9, 9), np.uint8)) == 0].any()
    full, blank = np.ones((100, 200), np.uint8), np.zeros((100, 200, 3), np.uint8)
    place_text(blank, full, ["dropped"], (0, 100))
    place_text(blank, full, [], (0, 100), force=True)
    assert not blank.any()
    place_text(blank, full, ["needed"], (0, 100), force=True)
    assert blank[70:, :80].any() and not blank[:60].any()


@pytest.mark.parametrize("room", [1.0, 60.0, 130.0, 150.0, 1000.0])
def test_wrapped_line_keeps_its_words_and_width_limit(room):
    text = "the bone's edge stops the tool 17.5 mm short"
    lines = wrap_line(text, room)
    wide = [cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines]
    assert " ".join(lines) == text
    assert all(width <= room or not BREAK_PATTERN.search(line) for width, line in zip(wide, lines, strict=True))
    assert (len(lines) == 1) is (room == 1000.0) and (room != 150.0 or max(wide) < 1.4 * min(wide))


def test_panel_wraps_lines_wider_than_the_image():
    colour = np.full((150, 200, 3), 90, np.uint8)
    shown = draw_text_panel(colour, ["a line that is much wider than so narrow a picture", "short"])
    changed = (shown != colour).any(axis=2)
    assert not changed[:, 193:].any() and changed[:, 150:190].any()


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("ms: deform 5900.6, render 13.3, overlay 8.4", ["ms: deform 5900.6,", "render 13.3,", "overlay 8.4"]),
        ("t 2.00 s, tumour moved 2.20 mm", ["t 2.00 s,", "tumour moved 2.20 mm"]),
        ("estimate moved 4.8 +- 2.9 mm", ["estimate moved 4.8 +- 2.9 mm"]),
        ("the tool reads 0.48 N within 0.01 N", ["tool reads 0.48 N", "within 0.01 N"]),
        ("neo-hookean, E 3 kPa, nu 0.49; to the left (0.87)", ["E 3 kPa,", "nu 0.49;", "left (0.87)"]),
        ("blue 95 % of its middle", ["blue 95 %"]),
    ],
)
def test_wrapping_keeps_number_with_name_and_unit(text, held):
    for room in (1.0, 60.0, 100.0):
        lines = wrap_line(text, room)
        assert " ".join(lines) == text and all(any(each in line for line in lines) for each in held)


def test_text_panel_drops_lines_instead_of_covering_marks():
    colour, hidden = np.full((300, 400, 3), 90, np.uint8), np.ones((300, 400), np.uint8)
    hidden[40:120, 200:] = 0
    lines = ["the first line", "the second", "the third", "the fourth", "the fifth", "the sixth"]
    for sights in ([np.ones_like(hidden), hidden], [hidden, np.zeros_like(hidden)]):
        changed = (draw_text_panel(colour, lines, obstacles=sights) != colour).any(axis=2)
        assert changed.sum() > 1000 and not changed[hidden > 0].any()
    assert (draw_text_panel(colour, lines[:2], obstacles=[hidden]) != colour).any(axis=2).sum() < changed.sum()


def test_text_labels_may_cover_thin_lines():
    """Example: a number over rings; otherwise it would be placed far below its line."""
    rows = {}
    for name, thin in (("far", None), ("near", True)):
        colour, taken = np.zeros((300, 400, 3), np.uint8), np.zeros((300, 400), np.uint8)
        taken[:200, ::20] = 1
        place_text(
            colour, taken, ["8.7 +- 8.0 mm"], (150, 60), parts=Hideable(ring_lines=None if thin is None else taken > 0)
        )
        _, rows[name], _, _ = find_text(colour, "8.7 +- 8.0 mm", TEXT_SCALE)
    assert rows["near"] < 60 + MAX_TEXT_SHIFT < 200 < rows["far"]

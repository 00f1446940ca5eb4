"""Marks next to a hidden surface: traces with dots, and visible points."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ar.optics.camera import Camera, look_at
from ar.overlay.composite import POINT_COLOUR, composite, draw_points
from ar.overlay.hud import TEXT_SCALE
from ar.overlay.marks import ImageText, MarkOutline, Marks
from ar.overlay.outlines import average_colour, compute_silhouette, find_colour, has_text, measure_outline_distance
from ar.rendering.layer import Layer
from ar.rendering.renderer import Lamp, Picture, render


def camera(width: int, height: int) -> Camera:
    eye = np.array([0.0, -0.05, 0.25])
    return look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]), np.radians(25.0), width, height)


def ground(here: Camera) -> Picture:
    corners = 0.09 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    sheet = Layer("cortex", 1, corners, np.array([[0, 1, 2], [0, 2, 3]]), (0.9, 0.6, 0.6))
    return render(here, [sheet], Lamp(np.array([0.05, 0.0, 0.3]), np.zeros(3), 0.1))


def tumour(centre=(0.0, 0.0, -0.02)) -> Layer:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.012)
    return Layer("tumour", 3, ball.vertices + np.array(centre), ball.faces, (0.2, 0.9, 0.3))


def test_displacement_trace_is_drawn_below_the_outline():
    here, at = camera(640, 480), tumour()
    picture = ground(here)
    blue = replace(tumour((0.004, 0.0, -0.02)), colour=np.array((0.2, 0.4, 1.0)))
    trace = MarkOutline(blue, (12, 4), np.array([0.004, 0.0, -0.02]))
    ink = average_colour(blue.colour)
    plain = composite(picture, here, at, style="contour", marks=Marks(initial=at)).colour
    shown = composite(
        picture,
        here,
        at,
        style="contour",
        marks=Marks(initial=at, outlines=[trace]),
        words=ImageText(motion=(2e-3, 1.24e-3)),
    ).colour
    assert not find_colour(plain, ink).any() and find_colour(shown, ink).sum() > 100
    own = find_colour(plain, average_colour(at.colour))
    assert own.sum() > 100 and find_colour(shown, average_colour(at.colour))[own].all()
    mask = compute_silhouette(here, blue.vertices, blue.triangles)
    assert (
        measure_outline_distance(shown, ink, mask, own, 32) < 2.5 < measure_outline_distance(plain, ink, mask, own, 32)
    )
    wrong = compute_silhouette(here, at.vertices + [0.0, 0.003, 0.0], at.triangles)
    assert measure_outline_distance(shown, ink, wrong, own, 32) > 5.0
    column, row = here.project(trace.dot_position[None])[0][0].round().astype(int)
    assert shown[row, column] == pytest.approx([153, 178, 255], abs=1)  # paler than the ink
    assert has_text(shown, "moved 2.0 +- 1.3 mm", TEXT_SCALE) and has_text(plain, "moved 0.0 mm", TEXT_SCALE)


def test_outline_gap_ignores_outlines_below_minimum_pixels():
    picture, mask = np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), bool)
    mask[20:40, 20:40] = True
    covered = np.ones((60, 60), bool)
    covered[:, 15:18] = False
    assert measure_outline_distance(picture, (9, 9, 9), mask, covered, 32) == 0.0
    assert measure_outline_distance(picture, (9, 9, 9), mask, np.zeros_like(mask), 32) == np.inf


def test_points_are_drawn_only_on_visible_free_pixels():
    here = camera(640, 480)
    over = composite(ground(here), here, tumour(), style="contour")
    points = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 9.0], [9.0, 0.0, 0.0]])
    pixels = here.project(points)[0].round()[:3].astype(int)
    where = np.ones(over.taken.shape, bool)
    where[pixels[1, 1], pixels[1, 0]] = False
    over.taken[pixels[2, 1], pixels[2, 0]] = 1
    before = over.colour.copy()
    draw_points(over, here, points, where)
    dotted = [(over.colour[row, column] == POINT_COLOUR).all() for column, row in pixels]
    assert dotted == [True, False, False] and 0 < (over.colour != before).any(axis=2).sum() < 30

"""Sections through camera, tip and tumour."""

import numpy as np
import pytest
from test_ar_styles import CAMERA, CORTEX, GREEN, seen, tumour

from ar.overlay.cut import EMPTY_COLOUR, CutPlane, build_plane, compute_surface_profile, draw_section
from ar.overlay.hud import WHITE
from ar.overlay.outlines import average_colour, find_colour, shift_shade
from ar.overlay.window import CLOSED_GROUND, LayerRoles


def test_cut_plane_contains_camera_tip_and_centre():
    middle, tip = np.array([0.0, 0.0, -0.02]), np.array([0.01, 0.004, 0.0])
    plane = build_plane(CAMERA, middle, tip)
    normal = np.cross(plane.across, plane.along)
    assert np.abs([(tip - middle) @ normal, (CAMERA.centre - middle) @ normal]).max() < 1e-12
    assert plane.across @ CAMERA.T_camera_world[0, :3] > 0.0
    level = build_plane(CAMERA, middle, CAMERA.centre + 0.9 * (middle - CAMERA.centre))
    np.testing.assert_allclose(level.across, build_plane(CAMERA, middle, None).across)
    assert abs(level.across @ CAMERA.T_camera_world[1, :3]) < 1e-12
    places = np.array([[0.002, -0.01], [0.0, 0.0]])
    np.testing.assert_allclose(plane.to_plane(plane.to_world(places)), places, atol=1e-15)


def test_section_shows_cortex_profile_and_tumour_area():
    picture, at = seen(0.0), tumour()
    plane: CutPlane = build_plane(CAMERA, at.vertices.mean(axis=0), None)
    roles = LayerRoles((), (CORTEX,)).read_roles(picture.segmentation)
    places, what = compute_surface_profile(CAMERA, plane, picture.depth, roles, 0.04)
    assert np.abs(plane.to_world(places)[:, 2]).max() < 2e-4  # the sheet lies at z = 0
    right = plane.to_world(places)[:, 0] > 5e-4
    assert (what[right] == CLOSED_GROUND).all() and not what[plane.to_world(places)[:, 0] < -5e-4].any()
    ink = shift_shade(average_colour(GREEN))
    inset = draw_section(CAMERA, at, plane, (places, what), (240, 180), ink)
    bar = np.flatnonzero((inset[-6] == np.asarray(WHITE, np.uint8)).all(axis=1))
    scale = (np.ptp(bar) - 1) / 0.01  # the bar is 10 mm
    assert find_colour(inset, ink).sum() == pytest.approx(np.pi * (0.012 * scale) ** 2, rel=0.1)
    assert find_colour(inset, EMPTY_COLOUR)[:8].mean() > 0.8 and not find_colour(inset, EMPTY_COLOUR)[-60:-20].any()


@pytest.mark.parametrize("error", [2e-3, 6e-3])
def test_section_draws_dashed_line_at_error_distance(error):
    at, ink = tumour(), shift_shade(average_colour(GREEN))
    plane = build_plane(CAMERA, at.vertices.mean(axis=0), None)
    places = plane.to_plane(np.array([[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0]])), np.zeros(2, int)
    with_line, without = (
        draw_section(CAMERA, at, plane, places, (240, 180), ink, error=each) for each in (error, None)
    )
    inside = np.argwhere(find_colour(without, ink))
    scale = np.ptp(inside[:, 1]) / 0.024
    away = np.linalg.norm(np.argwhere((with_line != without).any(axis=2)) - inside.mean(axis=0), axis=1) / scale
    assert len(away) > 40 and np.median(away) == pytest.approx(0.012 + error, abs=0.4e-3)

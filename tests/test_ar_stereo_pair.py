"""Cameras that move, zoom and focus, and pairs of them: against OpenCV and the thin lens."""

import cv2
import numpy as np
import pytest
from test_ar_camera import EYE, TARGET, points_in_front, some_camera
from test_ar_lens import SOME, scene, seen_by
from test_ar_renderer import LAMP

from ar.optics.camera import project_cv2
from ar.optics.stereo_pair import BASELINE, stereo_pair
from ar.rendering.renderer import render


def near_points() -> np.ndarray:
    """In view of every camera here."""
    return 0.3 * points_in_front()


def test_a_camera_is_moved_along_its_own_axes():
    camera, shift = some_camera(), np.array([0.01, -0.02, 0.03])
    moved = camera.moved(shift)
    assert np.allclose(moved.in_frame(points_in_front()), camera.in_frame(points_in_front()) - shift)
    assert moved.centre == pytest.approx(EYE + shift @ camera.T_camera_world[:3, :3])


def test_a_zoom_draws_larger_about_the_principal_point():
    for camera in (some_camera(), seen_by()):
        middle = camera.K[:2, 2]
        near = camera.zoomed(2.0)
        ways = [one.project(near_points())[0] - middle for one in (camera, near)]
        assert np.allclose(ways[1], 2.0 * ways[0])
        assert np.abs(project_cv2(near, near_points()) - near.project(near_points())[0]).max() < 1e-8
    for factor in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="above 0"):
            some_camera().zoomed(factor)


def test_focus_changes_the_size_as_a_thin_lens_does():
    """1 / f = 1 / d + 1 / b, and what is drawn is as large as b."""
    camera = some_camera()
    for d in (0.2, 0.3, 1e9):
        b = 1.0 / (1.0 / 50e-3 - 1.0 / d)
        start = 1.0 / (1.0 / 50e-3 - 1.0 / 0.25)
        assert camera.refocused(50e-3, 0.25, d).K[0, 0] == pytest.approx(camera.K[0, 0] * b / start)
    for wrong in ((50e-3, 0.25, 0.04), (0.0, 0.25, 0.3), (50e-3, np.nan, 0.3), (50e-3, 0.05, 0.3)):
        with pytest.raises(ValueError, match="focus farther"):
            camera.refocused(*wrong)


def test_parallel_eyes_see_the_same_rows_and_depth_by_disparity():
    camera = some_camera()
    left, right = stereo_pair(camera)
    assert np.linalg.norm(left.centre - right.centre) == pytest.approx(BASELINE) == pytest.approx(24e-3)
    (u, depth), (v, _) = (one.project(points_in_front()) for one in (left, right))
    assert np.allclose(u[:, 1], v[:, 1])
    assert np.allclose(u[:, 0] - v[:, 0], camera.K[0, 0] * BASELINE / depth)


def test_converging_eyes_meet_at_the_working_distance():
    camera = some_camera()
    distance = float(np.linalg.norm(TARGET - EYE))
    left, right = stereo_pair(camera, 30e-3, distance)
    for one in (left, right):
        assert one.project(TARGET)[0] == pytest.approx([159.5, 99.5], abs=1e-9)
    assert left.in_frame(right.centre)[0] > 0.0 and np.linalg.norm(left.centre - right.centre) == pytest.approx(30e-3)
    assert left.T_camera_world[2, :3] @ right.T_camera_world[2, :3] == pytest.approx(
        np.cos(2.0 * np.arctan(15e-3 / distance))
    )


def test_points_are_found_again_from_both_pictures_of_eyes_with_a_lens():
    """By OpenCV: undistorted and triangulated."""
    for pair in (stereo_pair(seen_by(SOME)), stereo_pair(seen_by(SOME), working_distance=0.14)):
        seen = []
        for one in pair:
            pixels = np.ascontiguousarray(one.project(near_points()[:50])[0])[:, None]
            seen.append(cv2.undistortPoints(pixels, one.K, SOME.coefficients).reshape(-1, 2).T)
        found = cv2.triangulatePoints(*(one.T_camera_world[:3] for one in pair), *seen)
        assert np.abs((found[:3] / found[3]).T - near_points()[:50]).max() < 1e-4
    pictures = [render(one, scene(), LAMP).colour for one in stereo_pair(seen_by(SOME))]
    assert (pictures[0] != pictures[1]).mean() > 0.1


def test_a_pair_that_cannot_be_is_refused():
    for wrong in ((0.0, None), (np.nan, None), (24e-3, 0.0), (24e-3, -1.0)):
        with pytest.raises(ValueError, match="above 0"):
            stereo_pair(some_camera(), *wrong)

"""A camera from views of the board: found as it was, as surely as repeated calibrations say, or refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_scenes import CAMERA, HEIGHT, WIDTH, K, picture, poses, views

from ar.tracking.board_views import find_board
from ar.tracking.intrinsics import calibrated
from ar.tracking.targets import Detector, calibration_board

BOARD = Detector([calibration_board()])
TRUTH = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *CAMERA.lens.coefficients[:5]])


def test_a_camera_is_found_from_pictures():
    places = poses(12)
    found = [find_board(BOARD, str(number), picture(T)) for number, T in enumerate(places)]
    assert all(found) and min(len(view.pixels) for view in found) > 20
    camera = calibrated(found, WIDTH, HEIGHT, "mine")
    assert camera.rms < 0.12 and not camera.left_out and camera.used == tuple(map(str, range(12)))
    np.testing.assert_allclose(camera.values[:4], TRUTH[:4], rtol=3e-3)
    assert (np.abs(camera.values - TRUTH) < 5.0 * camera.deviations).all()
    # Between the corners rays go where they should.
    rng = np.random.default_rng(3)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.3, 0.3, 200), np.ones(200)])
    off = camera.calibration.camera(np.eye(4)).project(rays)[0] - CAMERA.project(rays)[0]
    assert np.linalg.norm(off, axis=1).max() < 0.25
    assert (camera.calibration.width, camera.calibration.height, camera.calibration.name) == (WIDTH, HEIGHT, "mine")


@pytest.fixture(scope="module")
def repeated():
    """Twenty calibrations of one camera, by the same views with other noise of 0.2 pixel."""
    places = poses(14)
    return [calibrated(views(places, 0.2, seed), WIDTH, HEIGHT) for seed in range(20)]


def test_the_covariance_is_that_of_repeated_calibrations(repeated):
    values = np.array([each.values for each in repeated])
    stated = np.mean([each.covariance for each in repeated], axis=0)
    ratio = values.std(axis=0, ddof=1) / np.sqrt(np.diag(stated))
    assert (ratio > 1.0 / 1.5).all() and (ratio < 1.5).all(), ratio
    # With the covariances between them: squared distances of nine parameters are 9 on average, +- 1.
    squared = [
        (v - TRUTH) @ np.linalg.solve(each.covariance, v - TRUTH) for v, each in zip(values, repeated, strict=True)
    ]
    assert 6.0 < np.mean(squared) < 12.0
    assert all(each.rms == pytest.approx(np.sqrt(2) * 0.2, rel=0.1) for each in repeated)


def test_deviations_are_those_of_opencv(repeated):
    some = views(poses(14), 0.2, 0)
    points, pixels = ([np.float32(getattr(view, what)) for view in some] for what in ("points", "pixels"))
    rms, *_, deviations, _, _ = cv2.calibrateCameraExtended(points, pixels, (WIDTH, HEIGHT), None, None)
    np.testing.assert_allclose(repeated[0].deviations, np.ravel(deviations)[:9], rtol=2e-3)
    assert repeated[0].rms == pytest.approx(rms, rel=1e-3)


def test_a_view_that_does_not_fit_is_left_out_and_said():
    some = views(poses(14), 0.1)
    bent = replace(some[5], pixels=some[5].pixels + 3.0 * np.sin(some[5].pixels[:, ::-1] / 20.0))
    camera = calibrated([*some[:5], bent, *some[6:]], WIDTH, HEIGHT)
    assert camera.left_out == ("view 5",) and len(camera.used) == 13
    alone = calibrated([*some[:5], *some[6:]], WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.values, alone.values, rtol=1e-6)


def test_what_determines_no_camera_is_refused():
    with pytest.raises(ValueError, match=r"7 sharp views show the board, but 8 are needed: take 20 pictures"):
        calibrated(views(poses(7), 0.1), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"one direction in all 14 views, to \d+ degrees\. Tilt the board"):
        calibrated(views(poses(14, tilt=1.0), 0.1), WIDTH, HEIGHT)
    few = views(poses(14, tilt=10.0), 4.0)  # hardly tilted, and found badly
    with pytest.raises(ValueError, match=r"leave the focal length unknown to \d+ %\. Tilt"):
        calibrated(few, WIDTH, HEIGHT)
    some = views(poses(8), 0.1)
    bent = replace(some[5], pixels=some[5].pixels + 3.0 * np.sin(some[5].pixels[:, ::-1] / 20.0))
    with pytest.raises(ValueError, match=r"7 sharp views show the board, and 1 more fit badly, but 8"):
        calibrated([*some[:5], bent, *some[6:]], WIDTH, HEIGHT)

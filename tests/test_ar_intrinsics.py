"""Camera intrinsics from views of the board: values, covariance and rejected input."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_scenes import CAMERA, FACE, HEIGHT, WIDTH, K, picture, poses, views
from test_scenes_error_parts import turned

from ar.optics.camera import Camera
from ar.tracking.intrinsics import (
    calibrate_intrinsics,
    choose_views,
    compute_calibration_error,
    find_board,
    measure_covered_share,
    measure_tilt_range,
)
from ar.tracking.targets import Detector, build_calibration_board, build_patient_reference

BOARD = Detector([build_calibration_board()])
TRUTH = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *CAMERA.lens.coefficients[:5]])


def test_intrinsics_are_recovered_from_board_images():
    places = poses(12)
    found = [find_board(BOARD, str(number), picture(T)) for number, T in enumerate(places)]
    assert all(found) and min(len(view.pixels) for view in found) > 20
    camera = calibrate_intrinsics(found, WIDTH, HEIGHT, "mine")
    assert camera.rms < 0.12 and not camera.excluded_views and camera.used_views == tuple(map(str, range(12)))
    np.testing.assert_allclose(camera.parameters[:4], TRUTH[:4], rtol=3e-3)
    assert (np.abs(camera.parameters - TRUTH) < 5.0 * camera.deviations).all()
    # Between the corners rays go where they should.
    rng = np.random.default_rng(3)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.3, 0.3, 200), np.ones(200)])
    off = camera.calibration.build_camera(np.eye(4)).project(rays)[0] - CAMERA.project(rays)[0]
    assert np.linalg.norm(off, axis=1).max() < 0.25
    assert (camera.calibration.width, camera.calibration.height, camera.calibration.name) == (WIDTH, HEIGHT, "mine")


@pytest.fixture(scope="module")
def repeated():
    """Twenty calibrations of one camera, by the same views with other noise of 0.2 pixel."""
    places = poses(14)
    return [calibrate_intrinsics(views(places, 0.2, seed), WIDTH, HEIGHT) for seed in range(20)]


def test_covariance_matches_repeated_calibrations(repeated):
    values = np.array([each.parameters for each in repeated])
    stated = np.mean([each.covariance for each in repeated], axis=0)
    ratio = values.std(axis=0, ddof=1) / np.sqrt(np.diag(stated))
    assert (ratio > 1.0 / 1.5).all() and (ratio < 1.5).all(), ratio
    # With the covariances between them: squared distances of nine parameters are 9 on average, +- 1.
    squared = [
        (v - TRUTH) @ np.linalg.solve(each.covariance, v - TRUTH) for v, each in zip(values, repeated, strict=True)
    ]
    assert 6.0 < np.mean(squared) < 12.0
    assert all(each.rms == pytest.approx(np.sqrt(2) * 0.2, rel=0.1) for each in repeated)


def test_standard_deviations_equal_opencv_values(repeated):
    some = views(poses(14), 0.2, 0)
    points, pixels = ([np.float32(getattr(view, what)) for view in some] for what in ("points", "pixels"))
    rms, *_, deviations, _, _ = cv2.calibrateCameraExtended(points, pixels, (WIDTH, HEIGHT), None, None)
    np.testing.assert_allclose(repeated[0].deviations, np.ravel(deviations)[:9], rtol=2e-3)
    assert repeated[0].rms == pytest.approx(rms, rel=1e-3)


def test_calibration_excludes_and_names_distorted_view():
    some = views(poses(14), 0.1)
    bent = replace(some[5], pixels=some[5].pixels + 3.0 * np.sin(some[5].pixels[:, ::-1] / 20.0))
    camera = calibrate_intrinsics([*some[:5], bent, *some[6:]], WIDTH, HEIGHT)
    assert camera.excluded_views == ("view 5",) and len(camera.used_views) == 13
    alone = calibrate_intrinsics([*some[:5], *some[6:]], WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.parameters, alone.parameters, rtol=1e-6)


def test_calibration_rejects_insufficient_views():
    with pytest.raises(ValueError, match=r"7 sharp views show the board, but 8 are needed: take 20 images"):
        calibrate_intrinsics(views(poses(7), 0.1), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"one direction in all 14 views, to \d+ degrees\. Tilt the board"):
        calibrate_intrinsics(views(poses(14, tilt=1.0), 0.1), WIDTH, HEIGHT)
    few = views(poses(14, tilt=10.0), 4.0)  # hardly tilted, and found badly
    with pytest.raises(ValueError, match=r"leave the focal length unknown to \d+ %\. Tilt"):
        calibrate_intrinsics(few, WIDTH, HEIGHT)
    some = views(poses(8), 0.1)
    bent = replace(some[5], pixels=some[5].pixels + 3.0 * np.sin(some[5].pixels[:, ::-1] / 20.0))
    with pytest.raises(ValueError, match=r"7 sharp views show the board, and 1 more fit badly, but 8"):
        calibrate_intrinsics([*some[:5], bent, *some[6:]], WIDTH, HEIGHT)


def test_calibration_error_accounts_for_pose_compensation():
    """Focal length wrong by 0.2 %: the pose is fitted again, and a point next to the target moves in the image."""
    T, corners, place = turned("x", 25.0), build_patient_reference().faces[0].corners, np.array([0.1, 0.05, 0.03])
    T[:3, 3], own = (0.0, 0.02, 0.4), np.zeros((9, 9))
    own[:2, :2] = 4.0
    right, wrong = (np.array([[focal, 0.0, 400.0], [0.0, focal, 300.0], [0.0, 0.0, 1.0]]) for focal in (1e3, 1002.0))
    turn, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3].copy()
    pixels = cv2.projectPoints(corners, turn, shift, right, None)[0]
    again = cv2.solvePnP(corners, pixels, wrong, None, turn.copy(), shift.copy(), True)[1:]
    seen = [cv2.projectPoints(place, *pose, K, None)[0] for pose, K in (((turn, shift), right), (again, wrong))]
    expected = np.linalg.norm(seen[1] - seen[0]) / 1e3 * (T[:3, :3] @ place + T[:3, 3])[2]
    found = compute_calibration_error(Camera(right, np.eye(4), 800, 600), T, corners, place, own)
    assert np.sqrt(np.trace(found)) == pytest.approx(expected, rel=0.1)


def test_tilt_range_is_angle_between_board_planes():
    focal = max(WIDTH, HEIGHT)  # as it is assumed
    one, other = views(poses(2, tilt=20.0), 0.0)
    (R, _), (S, _) = ((T[:3, :3], T) for T in poses(2, tilt=20.0))
    true = np.arccos(R[:, 2] @ S[:, 2])
    assert abs(K[0, 0] - focal) / focal < 0.15 and measure_tilt_range([one, other], WIDTH, HEIGHT) == pytest.approx(
        true, rel=0.2
    )


def test_sharp_and_distinct_views_are_selected():
    places = poses(12)
    some = [replace(view, name=str(number)) for number, view in enumerate(views(places, 0.0))]
    again = [replace(view, name=f"{view.name} again") for view in some for _ in range(4)]
    blurred = replace(some[0], name="blurred", sharpness=0.3)
    assert len(choose_views([*again, *some, blurred], FACE, 100)) == 60
    few = choose_views([*again, blurred], FACE, 12)
    assert len({view.name for view in few}) == 12  # none twice
    assert choose_views([], FACE, 12) == []


def test_blur_in_any_direction_reduces_sharpness():
    plain = picture(poses(1, tilt=0.0)[0])
    sharp = find_board(BOARD, "sharp", plain).sharpness
    for size in ((5, 1), (1, 5)):
        assert find_board(BOARD, "moved", cv2.blur(plain, size)).sharpness < 0.6 * sharp
    dark = find_board(BOARD, "dark", (0.3 * plain).astype(np.uint8)).sharpness
    assert dark == pytest.approx(sharp, rel=0.1)


def test_board_with_too_few_visible_rows_is_not_detected():
    plain = picture(poses(12)[3])
    assert find_board(BOARD, "grey", np.full_like(plain, 120)) is None
    assert find_board(BOARD, "noise", np.random.default_rng(0).integers(0, 256, plain.shape, np.uint8)) is None
    frontal = picture(poses(1, tilt=0.0)[0])
    whole = find_board(BOARD, "whole", frontal)
    heights = [whole.pixels[whole.points[:, 1] == row, 1].mean() for row in np.unique(whole.points[:, 1])]
    for rows in (2, 3):  # all below is hidden
        hidden = frontal.copy()
        hidden[int(0.1 * heights[rows - 1] + 0.9 * heights[rows]) :] = 120
        view = find_board(BOARD, "hidden", hidden)
        assert view is None if rows == 2 else len(view.pixels) == 3 * (FACE.columns - 1)


def test_covered_share_is_area_spanned_by_corners():
    (one,) = views(poses(1, tilt=0.0), 0.0)
    box = replace(one, pixels=np.array([[0.0, 0.0], [319.0, 0.0], [319.0, 239.0], [0.0, 239.0], [100.0, 50.0]]))
    other = replace(box, pixels=box.pixels + [320.0, 0.0])
    assert measure_covered_share([box, box], WIDTH, HEIGHT) == pytest.approx(0.25)
    assert measure_covered_share([box, other], WIDTH, HEIGHT) == pytest.approx(0.5)

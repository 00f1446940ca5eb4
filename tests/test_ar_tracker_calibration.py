"""Hand-eye and pivot calibration: accuracy, deviation and rejected motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ar.tracking.tracker_calibration import calibrate_pivot, solve_hand_eye

TIP = np.array([0.002, -0.003, -0.15])


def rigid(turn, shift):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return T


def noisy(poses, degrees, metres, rng):
    """Each pose off by an angle and a distance, rms."""
    scale = np.sqrt(3.0)
    return np.array(
        [
            p @ rigid(np.radians(degrees) / scale * rng.normal(size=3), metres / scale * rng.normal(size=3))
            for p in poses
        ]
    )


def bodies(X, count=30, seed=0):
    """Poses of two bodies, the second of which lies in the first as X says, each in a tracker's frame of its own."""
    rng = np.random.default_rng(seed)
    first = np.array([rigid(0.5 * rng.normal(size=3), 0.1 * rng.normal(size=3)) for _ in range(count)])
    return first, np.linalg.inv(rigid([1.0, 0.2, 0.5], [0.5, -0.2, 1.1])) @ first @ X


@pytest.mark.parametrize("turn", [(0.3, -2.0, 0.5), (0.0, 0.0, 0.0), (np.pi, 0.0, 0.0), (0.0, 2.2, 2.2)])
@pytest.mark.parametrize("shift", [(0.05, -0.02, 0.12), (0.0, 0.0, 0.0)])
def test_hand_eye_is_exact_without_noise(turn, shift):
    X = rigid(turn, shift)
    found = solve_hand_eye(*bodies(X))
    np.testing.assert_allclose(found.X, X, atol=1e-12)
    assert found.rotation_error < 1e-6 and found.translation_error < 1e-12 and found.motion_count > 300


def test_hand_eye_error_with_noise_matches_published_error():
    """Noise of 0.3 degrees and 0.5 mm gives errors of 0.2 degrees and 0.5 mm."""
    X = rigid([0.3, -2.0, 0.5], [0.05, -0.02, 0.12])
    turns, shifts = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        found = solve_hand_eye(*(noisy(poses, 0.3, 5e-4, rng) for poses in bodies(X, seed=seed)))
        turns.append(np.degrees(Rotation.from_matrix(X[:3, :3].T @ found.X[:3, :3]).magnitude()))
        shifts.append(1e3 * np.linalg.norm(found.X[:3, 3] - X[:3, 3]))
        assert 0.3 < np.degrees(found.rotation_error) < 1.0 and 5e-4 < found.translation_error < 4e-3
        np.testing.assert_allclose(found.X[:3, :3] @ found.X[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.mean(turns) < 0.25 and np.mean(shifts) < 0.6


def test_underdetermined_hand_eye_motions_are_rejected():
    X = rigid([0.3, -2.0, 0.5], [0.05, -0.02, 0.12])
    first, second = bodies(X)
    with pytest.raises(ValueError, match=r"30 and 29 poses: give both"):
        solve_hand_eye(first, second[1:])
    with pytest.raises(ValueError, match=r"3 poses are too few"):
        solve_hand_eye(first[:3], second[:3])
    still = np.array([rigid(0.01 * np.array([k, -k, 0]), [0.01 * k, 0.0, 0.0]) for k in range(8)])
    with pytest.raises(ValueError, match=r"0 motions turn the bodies by more than 8 degrees"):
        solve_hand_eye(still, still @ X)
    rng = np.random.default_rng(1)
    about = np.array([rigid([0.0, 0.0, angle], rng.normal(size=3)) for angle in np.linspace(0.0, 2.0, 12)])
    with pytest.raises(ValueError, match=r"axes of all \d+ motions are parallel, to 0\.0 degrees"):
        solve_hand_eye(about, about @ X)


@pytest.mark.parametrize(("tilt", "is_parallel"), [(1.9, True), (2.2, False)])
def test_hand_eye_rotation_axes_within_8_degrees_are_rejected(tilt, is_parallel):
    """Rotations about axes tilted to both sides of z scatter just below and just above 8 degrees."""
    X, rng = rigid([0.3, -2.0, 0.5], [0.05, -0.02, 0.12]), np.random.default_rng(1)
    axes = [Rotation.from_euler("x", side * tilt, degrees=True).apply([0.0, 0.0, 1.0]) for side in (-1.0, 1.0)]
    turns = [0.0 * axes[0], *(angle * axis for angle in np.linspace(0.5, 2.0, 8) for axis in axes)]
    first = np.array([rigid(turn, 0.1 * rng.normal(size=3)) for turn in turns])
    second = np.linalg.inv(X) @ first @ X
    if not is_parallel:
        np.testing.assert_allclose(solve_hand_eye(first, second).X, X, atol=1e-9)
        return
    with pytest.raises(ValueError, match=r"are parallel, to [67]\.\d degrees"):
        solve_hand_eye(first, second)


def test_hand_eye_limits_the_number_of_motions():
    X = rigid([0.3, -2.0, 0.5], [0.05, -0.02, 0.12])
    found = solve_hand_eye(*bodies(X, count=1000))
    assert found.motion_count == 2000
    np.testing.assert_allclose(found.X, X, atol=1e-12)


def pivoting(count, tilt=30.0, around=1.0):
    """Poses of a tool whose tip stays at (0.1, 0.2, 0.3), tilted by up to an angle to all sides."""
    found = []
    for number in range(count):
        angle = 2.0 * np.pi * number / count
        turn = np.radians(tilt) * np.array([np.cos(angle), around * np.sin(angle), 0.5 * np.cos(3 * angle)])
        R = rigid(turn, np.zeros(3))
        R[:3, 3] = np.array([0.1, 0.2, 0.3]) - R[:3, :3] @ TIP
        found.append(R)
    return np.array(found)


def test_tip_deviation_matches_repeated_pivoting():
    exact = calibrate_pivot(pivoting(20))
    np.testing.assert_allclose(exact.tip, TIP, atol=1e-12)
    np.testing.assert_allclose(exact.centre, [0.1, 0.2, 0.3], atol=1e-12)
    assert exact.rms < 1e-12 and np.degrees(exact.tilt) == pytest.approx(
        23.7, abs=1.0
    )  # of its x: 30 sqrt((1 + 0.25) / 2)
    rng = np.random.default_rng(0)
    found = [calibrate_pivot(noisy(pivoting(40), 0.0, 5e-4, rng)) for _ in range(40)]
    stated = np.sqrt(np.mean([np.diag(each.covariance) for each in found], axis=0))
    seen = np.std([[*each.tip, *each.centre] for each in found], axis=0)
    assert (seen / stated < 1.5).all() and (stated / seen < 1.5).all()
    assert np.mean([each.rms for each in found]) == pytest.approx(5e-4, rel=0.1)


def test_insufficient_pivot_motion_is_rejected():
    with pytest.raises(ValueError, match=r"9 poses are too few"):
        calibrate_pivot(pivoting(9))
    with pytest.raises(ValueError, match=r"turns by 3\.\d degrees only .*tilt the tool by 30 degrees"):
        calibrate_pivot(pivoting(20, tilt=5.0))
    swung = np.array([rigid([0.0, angle, 0.0], np.zeros(3)) for angle in np.linspace(-1.0, 1.0, 20)])
    with pytest.raises(ValueError, match=r"turns by 0\.0 degrees only"):  # far, but about one axis
        calibrate_pivot(swung)

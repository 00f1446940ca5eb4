"""Poses of printed targets: detection, covariance, ambiguity and tracking."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.tracking.pose import PoseStatus, Tracker, find_pose
from ar.tracking.synthetic_images import render_targets
from ar.tracking.targets import (
    TIP_DISTANCE,
    DetectedCorners,
    Detector,
    Target,
    build_calibration_board,
    build_patient_reference,
    build_tool_cube,
)

CUBE, PLATE = build_tool_cube(), build_patient_reference()
K = np.array([[1000.0, 0.0, 410.0], [0.0, 1000.0, 295.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(K, np.eye(4), 800, 600, Lens(-0.15, 0.03, 1e-3, -5e-4))
TIP_AT = np.array([0.0, 0.0, -TIP_DISTANCE])


def looking(degrees: tuple[float, float, float], at: tuple[float, float, float]) -> np.ndarray:
    """T_camera_target (4, 4) of the cube with the corner between its faces towards the camera, turned, at [m]."""
    forward = -np.ones(3) / np.sqrt(3.0)
    right = -np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix() @ np.stack(
        [right, np.cross(forward, right), forward]
    )
    T[:3, 3] = at
    return T


def flat(degrees: tuple[float, float, float], at: tuple[float, float, float]) -> np.ndarray:
    """T_camera_target (4, 4) of a plate that faces the camera, turned, with its corner at [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    T[:3, 3] = at
    return T


def taken(*targets: tuple[Target, np.ndarray], camera: Camera = CAMERA, seed: int = 0) -> np.ndarray:
    """A picture with a little blur and noise."""
    sharp = render_targets(np.full((camera.height, camera.width), 120, np.uint8), camera, targets)
    blurred = cv2.GaussianBlur(sharp.astype(np.float64), (0, 0), 0.5)
    return np.clip(blurred + np.random.default_rng(seed).normal(0.0, 2.0, blurred.shape), 0, 255).astype(np.uint8)


def pixels_of(points: np.ndarray, T: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Where OpenCV has points (n, 3) of a target at T: (n, 2)."""
    assert camera.lens is not None
    found = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.lens.coefficients)
    return found[0].reshape(-1, 2)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Between two poses [degree]."""
    return float(np.degrees(Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude()))


def is_seen_from_front(
    T: np.ndarray, noise: float, rng: np.random.Generator, target: Target = PLATE
) -> DetectedCorners:
    """All corners of a target's faces that look at the camera, with white noise [pixel]."""
    rows = [
        (face.corners, np.full(len(face.corners), number))
        for number, face in enumerate(target.faces)
        if (T @ face.T_target_face)[:3, 2] @ (T @ face.T_target_face)[:3, 3] > 0.0
    ]
    points = np.concatenate([row[0] for row in rows])
    pixels = pixels_of(points, T) + rng.normal(0.0, noise, (len(points), 2))
    return DetectedCorners(points, pixels, np.concatenate([row[1] for row in rows]))


@pytest.fixture(scope="module")
def scene():
    poses = {
        "tool": looking((5.0, -8.0, 10.0), (0.03, -0.01, 0.25)),
        "patient": flat((20.0, 15.0, 5.0), (-0.08, 0.0, 0.28)),
    }
    return taken((CUBE, poses["tool"]), (PLATE, poses["patient"])), poses


def test_corners_are_detected_at_distorted_positions(scene):
    picture, poses = scene
    found = Detector((CUBE, PLATE)).detect(picture)
    assert len(found["patient"].points) >= 14 and len(np.unique(found["tool"].face)) == 3
    for name, corners in found.items():
        off = corners.pixels - pixels_of(corners.points, poses[name])
        assert np.sqrt(np.square(off).mean()) < 0.3 and np.abs(off.mean(axis=0)).max() < 0.1
    assert set(Detector((CUBE, PLATE)).detect(picture, ("tool",))) == {"tool"}
    assert not Detector((build_calibration_board(),)).detect(picture)
    assert not Detector((CUBE,)).detect(np.full((600, 800), 120, np.uint8))


def test_tip_error_lies_within_its_covariance(scene):
    picture, poses = scene
    tracked = Tracker(CAMERA, (CUBE, PLATE)).track(picture)
    assert set(tracked.statuses.values()) == {PoseStatus.GOOD}
    tip, covariance = tracked.poses["tool"].transform_point(TIP_AT)
    off = tip - (poses["tool"][:3, :3] @ TIP_AT + poses["tool"][:3, 3])
    assert np.linalg.norm(off) < 1.5e-3
    assert off @ np.linalg.solve(covariance, off) < 16.3  # 99.9 %
    assert angle(tracked.poses["patient"].T_camera_target, poses["patient"]) < 1.0


def test_pose_covariance_matches_repeated_noise():
    """Repeated corners with known noise: the mean squared Mahalanobis error is 6."""
    rng, T = np.random.default_rng(1), looking((10.0, 5.0, -20.0), (0.0, 0.02, 0.3))
    found = []
    for _ in range(150):
        verdict, pose = find_pose(CAMERA, CUBE, is_seen_from_front(T, 0.25, rng, CUBE))
        assert verdict is PoseStatus.GOOD and pose is not None
        turn = Rotation.from_matrix(pose.T_camera_target[:3, :3] @ T[:3, :3].T).as_rotvec()
        error = np.append(pose.T_camera_target[:3, 3] - T[:3, 3], turn)
        found.append(error @ np.linalg.solve(pose.covariance, error))
    assert np.mean(found) == pytest.approx(6.0, rel=0.2)
    assert np.mean(np.array(found) < 12.6) == pytest.approx(0.95, abs=0.05)


def test_relative_pose_covariance_includes_both_poses():
    """Tip in the patient's frame: noise of both poses gives the reported covariance."""
    rng, T = np.random.default_rng(6), looking((10.0, 5.0, -20.0), (0.0, 0.02, 0.3))
    plate = flat((30.0, 20.0, 0.0), (-0.1, 0.0, 0.3))
    true = (np.linalg.inv(plate) @ T @ [0.0, 0.0, -TIP_DISTANCE, 1.0])[:3]
    found = []
    for _ in range(150):
        tool = find_pose(CAMERA, CUBE, is_seen_from_front(T, 0.2, rng, CUBE))[1]
        patient = find_pose(CAMERA, PLATE, is_seen_from_front(plate, 0.2, rng))[1]
        assert tool is not None and patient is not None
        place, covariance = tool.transform_to(patient).transform_point(TIP_AT)
        found.append((place - true) @ np.linalg.solve(covariance, place - true))
    assert np.mean(found) == pytest.approx(3.0, rel=0.25)


def test_mirrored_pose_is_never_rated_good():
    """A distant plate that faces the camera has two fitting poses; a returned pose is the true one."""
    rng, verdicts = np.random.default_rng(2), []
    for _ in range(300):
        T = flat(tuple(rng.uniform(-25.0, 25.0, 3)), (0.05 * rng.normal(), 0.05 * rng.normal(), rng.uniform(0.4, 1.5)))
        verdict, pose = find_pose(CAMERA, PLATE, is_seen_from_front(T, 0.2, rng))
        verdicts.append(verdict)
        if pose is not None:
            assert (
                angle(pose.T_camera_target, T)
                < 6.0 * np.degrees(np.sqrt(np.linalg.eigvalsh(pose.covariance)[-1])) + 1.0
            )
    assert verdicts.count(PoseStatus.GOOD) > 40 and verdicts.count(PoseStatus.AMBIGUOUS) > 60


def test_previous_pose_resolves_the_mirror_ambiguity():
    rng, T = np.random.default_rng(3), flat((12.0, -10.0, 0.0), (0.0, 0.0, 1.0))
    corners = is_seen_from_front(T, 0.1, rng)
    assert find_pose(CAMERA, PLATE, corners)[0] is PoseStatus.AMBIGUOUS
    near = T.copy()
    near[:3, :3] = Rotation.from_euler("x", 2.0, degrees=True).as_matrix() @ T[:3, :3]
    for _ in range(10):  # in some the mirrored pose fits better
        verdict, pose = find_pose(CAMERA, PLATE, is_seen_from_front(T, 0.2, rng), near)
        assert verdict is PoseStatus.GOOD and pose is not None and angle(pose.T_camera_target, T) < 5.0
    far = flat((0.0, 0.0, 90.0), (0.0, 0.0, 1.0))
    assert find_pose(CAMERA, PLATE, corners, far) == (PoseStatus.AMBIGUOUS, None)


def test_inconsistent_corners_give_no_pose():
    corners = is_seen_from_front(flat((20.0, 15.0, 5.0), (-0.05, 0.0, 0.3)), 0.1, np.random.default_rng(4))
    few = DetectedCorners(corners.points[:5], corners.pixels[:5], corners.face[:5])
    assert find_pose(CAMERA, PLATE, few) == find_pose(CAMERA, PLATE, None) == (PoseStatus.LOST, None)
    strewn = replace(corners, pixels=corners.pixels[::-1] + np.random.default_rng(5).normal(0.0, 20.0, (16, 2)))
    assert find_pose(CAMERA, PLATE, strewn) == (PoseStatus.POOR, None)
    mirrored = replace(corners, pixels=corners.pixels * [-1.0, 1.0] + [800.0, 0.0])
    assert find_pose(CAMERA, PLATE, mirrored)[1] is None


def test_target_is_tracked_lost_and_detected_again(scene):
    picture, poses = scene
    tracker = Tracker(CAMERA, (CUBE,))
    first = tracker.track(picture)
    again = tracker.track(picture, first)  # in a window
    assert again.number == 1 and again.statuses["tool"] is PoseStatus.GOOD
    assert angle(again.poses["tool"].T_camera_target, first.poses["tool"].T_camera_target) < 1.0
    jumped = taken((CUBE, looking((0.0, 0.0, 0.0), (-0.05, 0.03, 0.24))))
    there = tracker.track(jumped, again)
    assert there.statuses["tool"] is PoseStatus.GOOD  # out of its window, so it was looked for everywhere
    nothing, state, lost = np.full((600, 800), 120, np.uint8), there, []
    for _ in range(7):
        state = tracker.track(nothing, state)
        lost.append(state.statuses["tool"])
        assert not state.poses
    assert set(lost) == {PoseStatus.LOST} and not state.last_poses
    seen = [(state := tracker.track(picture, state)).statuses["tool"] for _ in range(3)]
    assert seen[-1] is PoseStatus.GOOD
    assert angle(state.poses["tool"].T_camera_target, poses["tool"]) < 1.0


def test_tracker_rejects_image_of_other_size_or_type():
    tracker = Tracker(CAMERA, (CUBE,))
    with pytest.raises(ValueError, match="calibrate it at this size"):
        tracker.track(np.zeros((240, 320), np.uint8))
    with pytest.raises(ValueError, match="800 x 600 grey pixels of 8 bits"):
        tracker.track(np.zeros((600, 800, 3), np.uint8))

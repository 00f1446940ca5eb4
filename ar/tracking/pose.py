"""Poses of targets from their corners, with covariances, and tracking of targets over images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import cv2
import numpy as np

from ..optics.camera import Camera
from .rigid import build_cross_matrices, compute_rotation_angles
from .targets import DetectedCorners, Detector, Target, find_window, is_seen_from_front


@dataclass(frozen=True)
class PoseSettings:
    """Settings of `find_pose`."""

    min_corners: int = 6  # Minimum number of corners of a pose.
    min_deviation: float = 0.1  # Lower bound of the residual's standard deviation [pixel].
    max_residual: float = 1.0  # Largest rms residual of a pose [pixel].
    min_chi2_excess: float = 30.0  # Difference of chi^2 to the best pose beyond which another pose is excluded.
    turn_tolerance: float = np.radians(2.0)  # Rotation within which two poses count as equal [rad].
    shift_tolerance: float = 1e-3  # Distance within which two poses count as equal [m].
    # Largest rotation from the previous pose that selects one of two poses [rad]; the other must be twice as far.
    max_pose_turn: float = np.radians(15.0)


class PoseStatus(Enum):
    """Result of the pose estimation of a target in an image, as readable text."""

    GOOD = "seen"
    LOST = "lost: too few corners are seen"
    POOR = "lost: the corners fit no pose"
    AMBIGUOUS = "not certain: two poses fit the corners"


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of a target in the camera's frame, or in the frame of another target.

    Parameters
    ----------
    T_camera_target
        Pose (4, 4) [m].
    covariance
        Covariance (6, 6) of translation [m] and rotation [rad] about the target's origin, both in the axes of the
        camera frame.
    residual
        Root mean square distance [pixel] between detected and projected corners.
    corners
        Number of corners used.
    """

    T_camera_target: np.ndarray
    covariance: np.ndarray
    residual: float
    corners: int

    def transform_to(self, other: Pose) -> Pose:
        """Return this pose in the frame of another target of the same image; the covariance includes both errors."""
        into, away = other.T_camera_target[:3, :3].T, self.T_camera_target[:3, 3] - other.T_camera_target[:3, 3]
        none = np.zeros((3, 3))
        own = np.block([[into, none], [none, into]])
        theirs = np.block([[-into, into @ build_cross_matrices(away)], [none, -into]])
        covariance = own @ self.covariance @ own.T + theirs @ other.covariance @ theirs.T
        T = np.linalg.inv(other.T_camera_target) @ self.T_camera_target
        return Pose(T, covariance, max(self.residual, other.residual), min(self.corners, other.corners))

    def transform_point(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transform a point (3,) [m] of the target to the camera's frame; return it and its covariance (3, 3) [m^2]."""
        arm = self.T_camera_target[:3, :3] @ point
        slope = np.hstack([np.eye(3), -build_cross_matrices(arm)])
        return arm + self.T_camera_target[:3, 3], slope @ self.covariance @ slope.T


def find_pose(
    camera: Camera, target: Target, corners: DetectedCorners | None, previous: np.ndarray | None = None,
    settings: PoseSettings = PoseSettings(),
) -> tuple[PoseStatus, Pose | None]:  # fmt: skip
    """Estimate the pose of a target; return its status and the pose, which is None if uncertain or ambiguous.

    From each face, two mirrored poses can be computed (Schweighofer, Pinz 2006, "Robust pose estimation from a planar
    target", IEEE Trans. Pattern Anal. Mach. Intell. 28:2024-2030). Each is refined to all corners. The best pose is
    returned if no other pose fits about as well; else the pose nearest to `previous`, if clearly nearest.

    Parameters
    ----------
    camera
        Camera that took the image; its pose is ignored.
    corners
        Corners of `target` from `Detector.detect`; None if there are none.
    previous
        Last certain pose T_camera_target (4, 4); None if there is none.
    """
    if corners is None or len(corners.points) < settings.min_corners:
        return PoseStatus.LOST, None
    fits = sorted(_fit_candidates(camera, target, corners), key=lambda fit: fit[1])
    if not fits:
        return PoseStatus.POOR, None
    best, squares = fits[0]
    count = len(corners.points)
    residual = float(np.sqrt(squares / count))
    if not residual <= settings.max_residual:
        return PoseStatus.POOR, None
    variance = max(squares / (2 * count - 6), settings.min_deviation**2)
    limit = squares + settings.min_chi2_excess * variance
    rivals = [T for T, other in fits[1:] if other < limit and not _is_same_pose(T, best, settings)]
    if rivals:
        near = sorted([best, *rivals], key=lambda T: np.inf if previous is None else _compute_rotation(T, previous))
        if (
            previous is None
            or _compute_rotation(near[0], previous) > settings.max_pose_turn
            or _compute_rotation(near[1], previous) < 2.0 * _compute_rotation(near[0], previous)
        ):
            return PoseStatus.AMBIGUOUS, None
        best = near[0]
    return PoseStatus.GOOD, Pose(best, variance * _compute_covariance(camera, best, corners.points), residual, count)


def compute_pose_residual(camera: Camera, target: Target, corners: DetectedCorners) -> float:
    """Return the smallest sum of squared corner distances [pixel^2] of all candidate poses; inf if there are none."""
    return min((squares for _, squares in _fit_candidates(camera, target, corners)), default=np.inf)


def _fit_candidates(camera: Camera, target: Target, corners: DetectedCorners) -> list[tuple[np.ndarray, float]]:
    """Compute candidate poses (4, 4), each with the sum of squared distances of all corners [pixel^2]."""
    out = []
    for number in np.unique(corners.face):
        rows = corners.face == number
        if rows.sum() < 4:
            continue
        T_face = target.faces[number].T_target_face
        flat = (corners.points[rows] - T_face[:3, 3]) @ T_face[:3, :3]
        flat[:, 2] = 0.0
        found = cv2.solvePnPGeneric(flat, corners.pixels[rows], camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE)
        for turn, shift in zip(found[1], found[2], strict=True):
            T = _build_rigid(turn, shift) @ np.linalg.inv(T_face)
            if np.isfinite(T).all():
                fit = _refine_pose(camera, corners, T)
                out += [fit] if _is_facing_camera(target, corners, fit[0]) else []
    return out


def _refine_pose(camera: Camera, corners: DetectedCorners, T: np.ndarray) -> tuple[np.ndarray, float]:
    """Refine a pose T (4, 4) to all corners; return the pose and the sum of squared distances [pixel^2]."""
    turn, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3].reshape(3, 1).copy()
    turn, shift = cv2.solvePnPRefineLM(corners.points, corners.pixels, camera.K, camera.distortion, turn, shift)
    pixels = cv2.projectPoints(corners.points, turn, shift, camera.K, camera.distortion)[0].reshape(-1, 2)
    return _build_rigid(turn, shift), float(np.square(pixels - corners.pixels).sum())


def _is_facing_camera(target: Target, corners: DetectedCorners, T: np.ndarray) -> bool:
    """Return True if all faces with detected corners face the camera and are in front of it."""
    for number in np.unique(corners.face):
        T_camera_face = T @ target.faces[number].T_target_face
        if T_camera_face[2, 3] <= 0.0 or not is_seen_from_front(T_camera_face):
            return False
    return True


def _compute_covariance(camera: Camera, T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute the pose covariance (6, 6) for corner errors of variance 1 [pixel^2]."""
    arm = points @ T[:3, :3].T
    slopes = cv2.projectPoints(arm + T[:3, 3], np.zeros(3), np.zeros(3), camera.K, camera.distortion)[1][:, 3:6]
    by_place = slopes.reshape(-1, 2, 3)
    J = np.concatenate([by_place, -by_place @ build_cross_matrices(arm)], axis=2).reshape(-1, 6)
    return np.linalg.inv(J.T @ J)


def _build_rigid(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T


def _compute_rotation(pose: np.ndarray, reference: np.ndarray) -> float:
    """Compute the rotation angle [rad] between two poses."""
    return float(compute_rotation_angles(pose[:3, :3] @ reference[:3, :3].T))


def _is_same_pose(pose: np.ndarray, reference: np.ndarray, settings: PoseSettings) -> bool:
    shift = float(np.linalg.norm(pose[:3, 3] - reference[:3, 3]))
    return _compute_rotation(pose, reference) < settings.turn_tolerance and shift < settings.shift_tolerance


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of a `Tracker`."""

    search_margin: float = 0.4  # Search margin round a target's last outline, as a share of its size.
    min_search_margin: float = 32.0  # Minimum search margin round a target's last outline [pixel].
    max_pose_age: int = 5  # Age up to which a pose is used to predict the next [images].
    search_interval: int = 3  # Interval of searches for lost targets [images].
    pose: PoseSettings = PoseSettings()


@dataclass(frozen=True, eq=False)
class TrackedTargets:
    """Tracking result of one image, by target name.

    Parameters
    ----------
    number
        Number of the image.
    statuses
        Status of each target.
    poses
        Poses of the targets whose pose is certain.
    last_poses
        Last certain pose (4, 4) of each target, with the number of its image.
    """

    number: int
    statuses: Mapping[str, PoseStatus]
    poses: Mapping[str, Pose]
    last_poses: Mapping[str, tuple[np.ndarray, int]]


@dataclass(frozen=True, eq=False)
class Tracker:
    """Tracker of targets in successive images of one camera.

    Parameters
    ----------
    camera
        Calibrated camera; its pose is ignored.
    targets
        Targets with different names and different markers.
    settings
        Settings of the search and of the poses.
    """

    camera: Camera
    targets: tuple[Target, ...]
    settings: TrackerSettings = TrackerSettings()
    _detector: Detector = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", replace(self.camera, T_camera_world=np.eye(4)))
        object.__setattr__(self, "_detector", Detector(self.targets))

    def track(self, grey: np.ndarray, previous: TrackedTargets | None = None) -> TrackedTargets:
        """Find the targets in an image (H, W) uint8 of the camera's size; `previous` is the result of the last image.

        Raises
        ------
        ValueError
            The image has another size or type.
        """
        check_image_size(grey, self.camera.width, self.camera.height)
        number = 0 if previous is None else previous.number + 1
        earlier = {} if previous is None else previous.last_poses
        last = {name: each for name, each in earlier.items() if number - each[1] <= self.settings.max_pose_age}
        found = self._detect_corners(grey, number, last)
        verdicts, poses = {}, {}
        for target in self.targets:
            expected = last[target.name][0] if target.name in last else None
            seen = found.get(target.name)
            verdicts[target.name], pose = find_pose(self.camera, target, seen, expected, self.settings.pose)
            if pose is not None:
                poses[target.name] = pose
                last[target.name] = pose.T_camera_target, number
        return TrackedTargets(number, verdicts, poses, last)

    def _detect_corners(
        self, grey: np.ndarray, image_number: int, previous: Mapping[str, tuple[np.ndarray, int]]
    ) -> dict[str, DetectedCorners]:
        """Detect corners near the last poses; search lost targets in the whole image, at once and at intervals."""
        settings, found = self.settings, dict[str, DetectedCorners]()
        for target in self.targets:
            if target.name in previous:
                T = previous[target.name][0]
                outline = target.outline @ T[:3, :3].T + T[:3, 3]
                window = find_window(self.camera, outline, settings.search_margin, settings.min_search_margin)
                seen = None if window is None else self._detector.detect_in_window(target, grey, window)
                if seen is not None and len(seen.points) >= settings.pose.min_corners:
                    found[target.name] = seen
        missing = [target.name for target in self.targets if target.name not in found]
        just_left = any(previous.get(name, (None, -2))[1] == image_number - 1 for name in missing)
        if missing and (just_left or image_number % settings.search_interval == 0):
            found |= self._detector.detect(grey, missing)
        return found


def check_image_size(grey: np.ndarray, width: int, height: int) -> None:
    """Check that an image has the camera's size and 8-bit grey pixels.

    Raises
    ------
    ValueError
        The image has another size or type.
    """
    if grey.shape != (height, width) or grey.dtype != np.uint8:
        raise ValueError(
            f"the image is {' x '.join(map(str, grey.shape[::-1]))} of {grey.dtype}, and the camera takes "
            f"{width} x {height} grey pixels of 8 bits: calibrate it at this size."
        )

"""Poses of targets from their corners, with a covariance or the reason why none is known; targets that are followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import cv2
import numpy as np

from ..optics.camera import Camera
from .rigid import angles_of, cross_matrices
from .targets import Corners, Detector, Target, seen_from_front, window_round

# Corners that a pose needs at least; residuals are believed to be no smaller, and no larger, than these [pixel].
FEWEST, LEAST, MOST = 6, 0.1, 1.0
# Another pose must fit worse by so much of chi^2 before it is ruled out, unless it lies within these of the best one.
CLEARLY, ALIKE_TURN, ALIKE_SHIFT = 30.0, np.radians(2.0), 1e-3
# A pose before this one decides between two if it is within this of one, and twice as far from the other [rad].
NEAR = np.radians(15.0)


class Verdict(Enum):
    """What is known of a target in a picture, as a person reads it."""

    GOOD = "seen"
    LOST = "lost: too few corners are seen"
    POOR = "lost: the corners fit no pose"
    AMBIGUOUS = "not certain: two poses fit the corners"


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a target is in the camera's frame, or in that of another target.

    Parameters
    ----------
    T_camera_target
        (4, 4) [m].
    covariance
        (6, 6) of a shift in the camera's frame [m] and a small turn about the target's origin in its axes [rad].
    residual
        Root mean square distance [pixel] of the corners from where the pose has them.
    corners
        How many there are.
    """

    T_camera_target: np.ndarray
    covariance: np.ndarray
    residual: float
    corners: int

    def seen_from(self, other: Pose) -> Pose:
        """The same target in the frame of another one, of the same picture; both errors are in its covariance."""
        into, away = other.T_camera_target[:3, :3].T, self.T_camera_target[:3, 3] - other.T_camera_target[:3, 3]
        none = np.zeros((3, 3))
        own = np.block([[into, none], [none, into]])
        theirs = np.block([[-into, into @ cross_matrices(away)], [none, -into]])
        covariance = own @ self.covariance @ own.T + theirs @ other.covariance @ theirs.T
        T = np.linalg.inv(other.T_camera_target) @ self.T_camera_target
        return Pose(T, covariance, max(self.residual, other.residual), min(self.corners, other.corners))

    def point(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A place of the target (3,) [m] in the camera's frame (3,) [m], and its covariance (3, 3) [m^2]."""
        arm = self.T_camera_target[:3, :3] @ place
        slope = np.hstack([np.eye(3), -cross_matrices(arm)])
        return arm + self.T_camera_target[:3, 3], slope @ self.covariance @ slope.T


def pose_of(
    camera: Camera, target: Target, corners: Corners | None, before: np.ndarray | None = None
) -> tuple[Verdict, Pose | None]:
    """Where a target is; no pose unless it is certain.

    Every face has two poses that mirror each other (Schweighofer, Pinz 2006, "Robust pose estimation from a planar
    target", IEEE Trans. Pattern Anal. Mach. Intell. 28:2024-2030). Each is fitted to all corners. A pose is given where
    no other one fits about as well, or where a pose just `before` tells them apart.

    Parameters
    ----------
    camera
        As it took the picture; where it stands is of no account.
    corners
        Of `target`, as `Detector.seen` has them; None: none.
    before
        T_camera_target (4, 4) a moment ago, if it was certain.
    """
    if corners is None or len(corners.points) < FEWEST:
        return Verdict.LOST, None
    fits = sorted(_fits(camera, target, corners), key=lambda fit: fit[1])
    if not fits:
        return Verdict.POOR, None
    best, squares = fits[0]
    count = len(corners.points)
    residual = float(np.sqrt(squares / count))
    if not residual <= MOST:
        return Verdict.POOR, None
    variance = max(squares / (2 * count - 6), LEAST**2)
    rivals = [T for T, other in fits[1:] if other < squares + CLEARLY * variance and not _alike(T, best)]
    if rivals:
        near = sorted([best, *rivals], key=lambda T: np.inf if before is None else _turn(T, before))
        if before is None or _turn(near[0], before) > NEAR or _turn(near[1], before) < 2.0 * _turn(near[0], before):
            return Verdict.AMBIGUOUS, None
        best = near[0]
    return Verdict.GOOD, Pose(best, variance * _inverse_normal(camera, best, corners.points), residual, count)


def squares_of(camera: Camera, target: Target, corners: Corners) -> float:
    """The least sum of squared distances [pixel^2] of a target's corners, of all its poses; inf where none fits."""
    return min((squares for _, squares in _fits(camera, target, corners)), default=np.inf)


def _fits(camera: Camera, target: Target, corners: Corners) -> list[tuple[np.ndarray, float]]:
    """Poses (4, 4) that may be, and their squared distances of all corners [pixel^2]."""
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
            T = _rigid(turn, shift) @ np.linalg.inv(T_face)
            if np.isfinite(T).all():
                fit = _refined(camera, corners, T)
                out += [fit] if _faces_camera(target, corners, fit[0]) else []
    return out


def _refined(camera: Camera, corners: Corners, T: np.ndarray) -> tuple[np.ndarray, float]:
    """A pose fitted to all corners from T (4, 4) on, and the sum of squares [pixel^2]."""
    turn, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3].reshape(3, 1).copy()
    turn, shift = cv2.solvePnPRefineLM(corners.points, corners.pixels, camera.K, camera.distortion, turn, shift)
    pixels = cv2.projectPoints(corners.points, turn, shift, camera.K, camera.distortion)[0].reshape(-1, 2)
    return _rigid(turn, shift), float(np.square(pixels - corners.pixels).sum())


def _faces_camera(target: Target, corners: Corners, T: np.ndarray) -> bool:
    """Whether every face with corners is seen from its front, and lies before the camera."""
    for number in np.unique(corners.face):
        T_camera_face = T @ target.faces[number].T_target_face
        if T_camera_face[2, 3] <= 0.0 or not seen_from_front(T_camera_face):
            return False
    return True


def _inverse_normal(camera: Camera, T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The covariance (6, 6) that corners of unit variance give."""
    arm = points @ T[:3, :3].T
    slopes = cv2.projectPoints(arm + T[:3, 3], np.zeros(3), np.zeros(3), camera.K, camera.distortion)[1][:, 3:6]
    by_place = slopes.reshape(-1, 2, 3)
    J = np.concatenate([by_place, -by_place @ cross_matrices(arm)], axis=2).reshape(-1, 6)
    return np.linalg.inv(J.T @ J)


def _rigid(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T


def _turn(one: np.ndarray, other: np.ndarray) -> float:
    """The angle [rad] between two poses."""
    return float(angles_of(one[:3, :3] @ other[:3, :3].T))


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    return _turn(one, other) < ALIKE_TURN and float(np.linalg.norm(one[:3, 3] - other[:3, 3])) < ALIKE_SHIFT


# Round what a target covered, such a share of its size is looked at, and so many pixels at least.
AROUND, MARGIN = 0.4, 32.0
# A pose that is so many pictures old says nothing of the next; what is lost is looked for in every so many pictures.
STALE, SEARCHED = 5, 3


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one picture says of each target, by name.

    Parameters
    ----------
    number
        Of the picture.
    verdicts
        What is known.
    poses
        Of those that are certain.
    last
        The pose (4, 4) that was certain last, and the picture's number, of all that were.
    """

    number: int
    verdicts: Mapping[str, Verdict]
    poses: Mapping[str, Pose]
    last: Mapping[str, tuple[np.ndarray, int]]


@dataclass(frozen=True, eq=False)
class Tracker:
    """Follows targets in the pictures of one camera.

    Parameters
    ----------
    camera
        As calibrated; where it stands is of no account.
    targets
        Of different names, and with different markers.
    """

    camera: Camera
    targets: tuple[Target, ...]
    _detector: Detector = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", replace(self.camera, T_camera_world=np.eye(4)))
        object.__setattr__(self, "_detector", Detector(self.targets))

    def track(self, grey: np.ndarray, before: Tracked | None = None) -> Tracked:
        """Where the targets are in a picture (H, W) uint8, of the camera's size; `before` is what the last one said.

        Raises
        ------
        ValueError
            A picture of another size or kind.
        """
        demand_picture(grey, self.camera.width, self.camera.height)
        number = 0 if before is None else before.number + 1
        last = {} if before is None else {k: each for k, each in before.last.items() if number - each[1] <= STALE}
        found = self._seen(grey, number, last)
        verdicts, poses = {}, {}
        for target in self.targets:
            expected = last[target.name][0] if target.name in last else None
            verdicts[target.name], pose = pose_of(self.camera, target, found.get(target.name), expected)
            if pose is not None:
                poses[target.name] = pose
                last[target.name] = pose.T_camera_target, number
        return Tracked(number, verdicts, poses, last)

    def _seen(self, grey: np.ndarray, number: int, last: Mapping[str, tuple[np.ndarray, int]]) -> dict[str, Corners]:
        """Corners of targets where they were; of those that left, and now and then of the lost, everywhere."""
        found: dict[str, Corners] = {}
        for target in self.targets:
            if target.name in last:
                T, outline = last[target.name][0], target.outline
                window = window_round(self.camera, outline @ T[:3, :3].T + T[:3, 3], AROUND, MARGIN)
                seen = None if window is None else self._detector.seen_in(target, grey, window)
                found |= {target.name: seen} if seen is not None and len(seen.points) >= FEWEST else {}
        missing = [target.name for target in self.targets if target.name not in found]
        just_left = any(last.get(name, (None, -2))[1] == number - 1 for name in missing)
        if missing and (just_left or number % SEARCHED == 0):
            found |= self._detector.seen(grey, missing)
        return found


def demand_picture(grey: np.ndarray, width: int, height: int) -> None:
    """Refuse a picture that a camera of so many pixels does not take.

    Raises
    ------
    ValueError
        A picture of another size or kind.
    """
    if grey.shape != (height, width) or grey.dtype != np.uint8:
        raise ValueError(
            f"the picture is {' x '.join(map(str, grey.shape[::-1]))} of {grey.dtype}, and the camera takes "
            f"{width} x {height} grey pixels of 8 bits: calibrate it at this size."
        )

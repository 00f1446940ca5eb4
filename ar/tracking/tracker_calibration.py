"""Calibration of a tracker: hand-eye calibration of a camera, and pivot calibration of a tool's tip."""

from dataclasses import dataclass

import numpy as np

from .rigid import build_cross_matrices, compute_rotation_angles

# Largest root mean square residual angle of motions [rad]: two trackers with noise of 0.5 degrees give 1 degree.
MAX_RESIDUAL_TURN = np.radians(2.0)
# Largest root mean square residual distance of motions [m]: two trackers with noise of 0.5 degrees give 7 mm over 0.7
# m.
MAX_RESIDUAL_SHIFT = 10e-3
REMEDY = "Turn the bodies by 30 degrees or more, about at least two different axes."  # Remedy in error messages.


@dataclass(frozen=True)
class HandEyeSettings:
    """Settings of `solve_hand_eye`."""

    min_poses: int = 4  # Minimum number of pairs of poses.
    # Smallest rotation of a motion that is used [rad]; the axis of a smaller rotation is uncertain.
    min_turn: float = np.radians(8.0)
    # Largest rotation of a motion that is used [rad]; near pi the sign of its axis is uncertain.
    max_turn: float = np.radians(170.0)
    # Smallest root mean square angle of the axes from their closest common axis [rad].
    min_axis_spread: float = np.radians(8.0)
    max_motions: int = 2000  # Maximum number of motions, the largest first.
    max_poses: int = 300  # Maximum number of poses, evenly spread, of which all pairs are examined.


@dataclass(frozen=True, eq=False)
class HandEye:
    """Result of a hand-eye calibration: pose of the second body in the first.

    Parameters
    ----------
    X
        Transform (4, 4) [m]: x_first = X x_second.
    rotation_error, translation_error
        Root mean square over motions of the angle [rad] and of the distance [m] between A X and X B.
    motion_count
        Number of motions used.
    axis_spread
        Root mean square angle [rad] of the motions' axes from their closest common axis.
    distances
        Root mean square translation residuals (n,) [m] of the motions from and to each pose; 0 without motions.
    """

    X: np.ndarray
    rotation_error: float
    translation_error: float
    motion_count: int
    axis_spread: float
    distances: np.ndarray

    @property
    def misfit(self) -> str:
        """Description of residuals above their limits; empty if both are within their limits."""
        if self.rotation_error <= MAX_RESIDUAL_TURN and self.translation_error <= MAX_RESIDUAL_SHIFT:
            return ""
        angle, distance = np.degrees(self.rotation_error), 1e3 * self.translation_error
        found = f"motions of the bodies differ by {angle:.1f} degrees and {distance:.1f} mm (rms)"
        return f"{found}: at most {np.degrees(MAX_RESIDUAL_TURN):.0f} and {1e3 * MAX_RESIDUAL_SHIFT:.0f} are required"


def solve_hand_eye(poses_a: np.ndarray, poses_b: np.ndarray, settings: HandEyeSettings = HandEyeSettings()) -> HandEye:
    """Compute X with A X = X B for all motions A and B of two bodies, from their poses (n, 4, 4) [m] in their trackers.

    Between poses i and j, the first body's motion is A = P_i^-1 P_j, the second's B = Q_i^-1 Q_j. Daniilidis (1999),
    "Hand-eye calibration using dual quaternions", equations 31 to 38: X is in the null space of a 6 m x 8 matrix.

    Raises
    ------
    ValueError
        The numbers of poses differ, there are too few poses, rotations are too small, or all axes are parallel.
    """
    if len(poses_a) != len(poses_b):
        raise ValueError(f"{len(poses_a)} and {len(poses_b)} poses: give both bodies' poses at the same times.")
    if len(poses_a) < settings.min_poses:
        raise ValueError(f"{len(poses_a)} poses are too few: record {settings.min_poses} or more. {REMEDY}")
    A, B, ends = _select_motions(poses_a, poses_b, settings)
    (a, a_dual), (b, b_dual) = to_dual_quaternions(A), to_dual_quaternions(B)
    axes = a[:, 1:] / np.linalg.norm(a[:, 1:], axis=1, keepdims=True)
    across = 1.0 - np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1]
    spread = float(np.arcsin(np.sqrt(np.clip(across, 0.0, 1.0))))
    if spread < settings.min_axis_spread:
        raise ValueError(
            f"the axes of all {len(A)} motions are parallel, to {np.degrees(spread):.1f} degrees: they leave open "
            f"where along the axis one body lies in the other. {REMEDY}"
        )
    X = _solve_transform(a, a_dual, b, b_dual)
    left, right = A @ X, X @ B
    turns = compute_rotation_angles(left[:, :3, :3] @ right[:, :3, :3].transpose(0, 2, 1))
    shifts = np.linalg.norm(left[:, :3, 3] - right[:, :3, 3], axis=1)
    squares, counts = (np.bincount(ends.ravel(), each, len(poses_a)) for each in (np.tile(shifts**2, 2), None))
    return HandEye(
        X, _compute_rms(turns), _compute_rms(shifts), len(A), spread, np.sqrt(squares / np.maximum(counts, 1))
    )


def _select_motions(
    poses_a: np.ndarray, poses_b: np.ndarray, settings: HandEyeSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Select the motions (m, 4, 4) of both bodies with the largest rotations; return also their pose indices (2, m)."""
    kept = np.unique(np.linspace(0, len(poses_a) - 1, min(len(poses_a), settings.max_poses)).round().astype(int))
    start, end = np.triu_indices(len(kept), 1)
    A, B = (np.linalg.inv(poses[kept])[start] @ poses[kept][end] for poses in (poses_a, poses_b))
    angles = np.array([compute_rotation_angles(M[:, :3, :3]) for M in (A, B)])
    good = np.flatnonzero((angles.min(axis=0) > settings.min_turn) & (angles.max(axis=0) < settings.max_turn))
    if len(good) < settings.min_poses:
        raise ValueError(
            f"{len(good)} motions turn the bodies by more than {np.degrees(settings.min_turn):.0f} degrees, and "
            f"{settings.min_poses} are needed. {REMEDY}"
        )
    best = good[np.argsort(-angles[0, good], kind="stable")[: settings.max_motions]]
    return A[best], B[best], kept[[start[best], end[best]]]


def to_dual_quaternions(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert rigid motions (n, 4, 4) to dual quaternions: real and dual parts (n, 4), real scalars first and >= 0."""
    R = T[:, :3, :3]
    # Bar-Itzhack (2000), "New method for extracting the quaternion": an eigenvector, whatever the angle.
    N = np.empty((len(T), 4, 4))
    N[:, 0, 0] = np.trace(R, 0, 1, 2)
    N[:, 0, 1:] = N[:, 1:, 0] = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    N[:, 1:, 1:] = R + R.transpose(0, 2, 1) - np.eye(3) * N[:, 0, 0, None, None]
    real = np.linalg.eigh(N)[1][:, :, -1]
    real *= np.where(real[:, :1] < 0.0, -1.0, 1.0)
    shift = np.concatenate([np.zeros((len(T), 1)), T[:, :3, 3]], axis=1)
    return real, 0.5 * _multiply_quaternions(shift, real)


def _multiply_quaternions(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Multiply quaternions (..., 4) with the scalar first."""
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(axis=-1, keepdims=True)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def _solve_transform(a: np.ndarray, a_dual: np.ndarray, b: np.ndarray, b_dual: np.ndarray) -> np.ndarray:
    """Solve for X (4, 4), given real and dual parts (m, 4) of both bodies' motions."""
    rows = np.zeros((len(a), 6, 8))
    for place, one, other in ((0, a, b), (3, a_dual, b_dual)):
        rows[:, place : place + 3, 0] = (one - other)[:, 1:]
        rows[:, place : place + 3, 1:4] = build_cross_matrices((one + other)[:, 1:])
    rows[:, 3:, 4] = (a - b)[:, 1:]
    rows[:, 3:, 5:] = build_cross_matrices((a + b)[:, 1:])
    one, other = np.linalg.svd(rows.reshape(-1, 8), full_matrices=False)[2][-2:]
    u, v, w, z = one[:4], one[4:], other[:4], other[4:]
    # (k u + m w, k v + m z) is a unit dual quaternion: its parts are at right angles, and the real one has length 1.
    # With (k, m) = (cos t, sin t), the first is c + d cos 2t + e sin 2t = 0.
    c, d, e = u @ v + w @ z, u @ v - w @ z, u @ z + w @ v
    angles = 0.5 * (
        np.arctan2(e, d) + np.arccos(np.clip(-c / max(np.hypot(d, e), 1e-300), -1.0, 1.0)) * np.array([1.0, -1.0])
    )
    pairs = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reals, duals = pairs @ [u, w], pairs @ [v, z]
    lengths = np.linalg.norm(reals, axis=1)
    best = lengths.argmax()
    real, dual = reals[best] / lengths[best], duals[best] / lengths[best]
    X = np.eye(4)
    x, y = real[0], real[1:]
    X[:3, :3] = (x * x - y @ y) * np.eye(3) + 2.0 * np.outer(y, y) + 2.0 * x * build_cross_matrices(y[None])[0]
    X[:3, 3] = 2.0 * _multiply_quaternions(dual, real * [1.0, -1.0, -1.0, -1.0])[1:]
    return X


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


MIN_PIVOT_POSES = 10  # Minimum number of poses of a pivot calibration.
MIN_TILT = np.radians(5.0)  # Smallest root mean square rotation angle of any direction in the tool [rad].
# Largest root mean square distance [m]: tracker noise of 0.5 mm and 0.5 degrees, at a tip 300 mm away, gives 2.7 mm.
MAX_RMS = 3e-3


@dataclass(frozen=True, eq=False)
class Pivot:
    """Result of a pivot calibration: tip of a tool.

    Parameters
    ----------
    tip
        Position (3,) [m] of the tip in the tool's frame.
    centre
        Position (3,) [m] of the fixed pivot point in the tracker's frame.
    covariance
        Joint covariance (6, 6) [m^2] of `tip` and `centre`.
    rms
        Root mean square distance [m] between the centre and the tip at each pose.
    tilt
        Root mean square rotation angle [rad] of the direction in the tool with the least rotation.
    distances
        Distance (n,) [m] between the centre and the tip for each pose.
    """

    tip: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray
    rms: float
    tilt: float
    distances: np.ndarray

    @property
    def misfit(self) -> str:
        """Description of a residual above its limit; empty if it is within the limit."""
        if self.rms <= MAX_RMS:
            return ""
        return f"the tip moves by {1e3 * self.rms:.1f} mm (rms): at most {1e3 * MAX_RMS:.0f} mm are required"


def calibrate_pivot(poses: np.ndarray) -> Pivot:
    """Compute the tip from poses T (n, 4, 4) [m] of a tool, x_world = T x_tool, so that all R_i tip + p_i coincide.

    Algebraic least squares: the one-step method of Yaniv (2015), "Which pivot calibration?", R_i tip - centre = -p_i.

    Raises
    ------
    ValueError
        There are too few poses, or the tool rotates too little.
    """
    count = len(poses)
    if count < MIN_PIVOT_POSES:
        raise ValueError(f"{count} poses are too few: hold the tip in one place, and record {MIN_PIVOT_POSES} or more.")
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    mean = turns.mean(axis=0)
    # The tip's normal matrix over n, after the centre is eliminated: rotation of each direction in the tool.
    tilt = float(np.sqrt(max(np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)[0], 0.0)))
    if tilt < MIN_TILT:
        raise ValueError(
            f"a direction in the tool turns by {np.degrees(tilt):.1f} degrees only (rms), and "
            f"{np.degrees(MIN_TILT):.0f} are needed: tilt the tool by 30 degrees to all sides while its tip stays."
        )
    system = np.concatenate([turns, np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(system, -places.ravel(), rcond=None)[0]
    residuals = system @ solution + places.ravel()
    variance = residuals @ residuals / (3 * count - 6)
    covariance = variance * np.linalg.inv(system.T @ system)
    distances = np.linalg.norm(residuals.reshape(-1, 3), axis=1)
    rms = float(np.sqrt(distances @ distances / count))
    return Pivot(solution[:3], solution[3:], 0.5 * (covariance + covariance.T), rms, tilt, distances)

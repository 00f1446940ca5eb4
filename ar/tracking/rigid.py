"""Rotations and rigid motions as matrices: how far they turn, what they are about, and whether they are any."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3) from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*vectors.shape, 3)


def angles_of(rotations: np.ndarray) -> np.ndarray:
    """By how much rotations (..., 3, 3) turn (...) [rad]."""
    return np.arccos(np.clip(0.5 * (np.trace(rotations, 0, -2, -1) - 1.0), -1.0, 1.0))


def moved_about(T: np.ndarray, centre: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A rigid motion T (4, 4) after a shift [m] and a turn [rad], `step` (6,), about what was `centre` (3,) [m]."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
    out[:3, 3] = T[:3, :3] @ centre + T[:3, 3] + step[:3] - out[:3, :3] @ centre
    return out


def is_rigid(T: np.ndarray, rounding: float) -> bool:
    """Whether a matrix is a rotation and a shift (4, 4); its columns may be so far from square."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    turn = T[:3, :3]
    return bool(np.abs(turn.T @ turn - np.eye(3)).max() < rounding and np.linalg.det(turn) > 0.0)


def turn_vectors(rotations: np.ndarray) -> np.ndarray:
    """Axes (n, 3) of rotations (n, 3, 3), as long as they turn [rad]."""
    return Rotation.from_matrix(rotations).as_rotvec()


def reread(poses: np.ndarray) -> dict[str, np.ndarray]:
    """Poses (n, 4, 4) as they are, and under other conventions for their quaternions, by the convention."""
    read = Rotation.from_matrix(poses[:, :3, :3])
    forms = {"": read, "as w, x, y, z": Rotation.from_quat(np.roll(read.as_quat(), -1, axis=1)), "inverted": read.inv()}
    found = {how: poses.copy() for how in forms}
    for how, turns in forms.items():
        found[how][:, :3, :3] = turns.as_matrix()
    return found

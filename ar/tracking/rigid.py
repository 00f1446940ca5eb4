"""Rotations and rigid motions as matrices: conversions, angles, and validation."""

import numpy as np
from scipy.spatial.transform import Rotation


def build_cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Build the matrices (..., 3, 3) of the cross product with `vectors` (..., 3) from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*vectors.shape, 3)


def compute_rotation_angles(rotations: np.ndarray) -> np.ndarray:
    """Compute the angles (...) [rad] of rotations (..., 3, 3)."""
    return np.arccos(np.clip(0.5 * (np.trace(rotations, 0, -2, -1) - 1.0), -1.0, 1.0))


def move_rigidly(T: np.ndarray, centre: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Apply `step` (6,), shift [m] and rotation [rad] about the moved `centre` (3,) [m], to a motion T (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
    out[:3, 3] = T[:3, :3] @ centre + T[:3, 3] + step[:3] - out[:3, :3] @ centre
    return out


def is_rigid(T: np.ndarray, tolerance: float) -> bool:
    """Return True if T (4, 4) is a rigid motion; entries of R^T R - 1 must be below `tolerance`."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    turn = T[:3, :3]
    return bool(np.abs(turn.T @ turn - np.eye(3)).max() < tolerance and np.linalg.det(turn) > 0.0)


def to_rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Convert rotations (n, 3, 3) to rotation vectors (n, 3) [rad]."""
    return Rotation.from_matrix(rotations).as_rotvec()


def list_conventions(poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return poses (n, 4, 4) by quaternion convention: as given, and reinterpreted under other conventions."""
    read = Rotation.from_matrix(poses[:, :3, :3])
    forms = {"": read, "as w, x, y, z": Rotation.from_quat(np.roll(read.as_quat(), -1, axis=1)), "inverted": read.inv()}
    found = {how: poses.copy() for how in forms}
    for how, turns in forms.items():
        found[how][:, :3, :3] = turns.as_matrix()
    return found

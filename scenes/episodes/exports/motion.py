"""The tool's motion as numbers that learn well: a pose as place and quaternion, a step as a twist."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

STATE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
ACTION = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")


def states(poses: np.ndarray) -> np.ndarray:
    """(T, 7) float32 of `T_world_tool` (T, 4, 4): origin [m], and quaternion x, y, z, w that does not jump in sign."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    flips = np.sign(np.einsum("ij,ij->i", turns[1:], turns[:-1]))
    turns[1:] *= np.cumprod(np.where(flips < 0.0, -1.0, 1.0))[:, None]
    return np.concatenate([poses[:, :3, 3], turns], axis=1).astype(np.float32)


def twists(poses: np.ndarray) -> np.ndarray:
    """(T, 6) float32: shift of the tool's origin [m] and its turn [rad], both in world axes, to the next frame.

    The last is zero.
    """
    shifts = np.diff(poses[:, :3, 3], axis=0)
    turns = Rotation.from_matrix(poses[1:, :3, :3]) * Rotation.from_matrix(poses[:-1, :3, :3]).inv()
    found = np.concatenate([shifts, turns.as_rotvec().reshape(-1, 3)], axis=1)
    return np.concatenate([found, np.zeros((1, 6))]).astype(np.float32)

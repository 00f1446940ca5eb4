"""Rotations as matrices: how far they turn, and cross products written as products."""

from __future__ import annotations

import numpy as np


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3) from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*vectors.shape, 3)


def angles_of(rotations: np.ndarray) -> np.ndarray:
    """By how much rotations (..., 3, 3) turn (...) [rad]."""
    return np.arccos(np.clip(0.5 * (np.trace(rotations, 0, -2, -1) - 1.0), -1.0, 1.0))

"""How large triangles are."""

from __future__ import annotations

import numpy as np


def edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Of each edge (S, 3) [m] of triangles with corners (S, 3, 3) [m]."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def areas(corners: np.ndarray) -> np.ndarray:
    """(S,) [m^2] of triangles with corners (S, 3, 3) [m]."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

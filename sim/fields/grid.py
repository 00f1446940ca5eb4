"""Regular grids along the axes of the patient's space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes at `origin` (3,) + `spacing` (i, j, k) [m], RAS, for i, j, k below `shape`."""

    origin: np.ndarray
    spacing: float
    shape: tuple[int, int, int]

    @property
    def affine(self) -> np.ndarray:
        """From indices to metres (4, 4)."""
        affine = np.diag([self.spacing] * 3 + [1.0])
        affine[:3, 3] = self.origin
        return affine

    def index(self, points: np.ndarray) -> np.ndarray:
        """Return indices (..., 3), not whole, of points (..., 3) [m]."""
        return (points - self.origin) / self.spacing

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """Places (n, 3) [m] of nodes by their numbers (n,) in the flat grid."""
        return self.origin + self.spacing * np.stack(np.unravel_index(numbers, self.shape), axis=-1)

    def corners(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n, 8) of the nodes of the cells in which points (n, 3) [m] lie, and their weights (n, 8)."""
        index = self.index(points)
        first = np.clip(np.floor(index).astype(int), 0, np.array(self.shape) - 2)
        share = index - first
        strides = np.array([self.shape[1] * self.shape[2], self.shape[2], 1])
        numbers = (first @ strides)[:, None] + np.array(list(np.ndindex(2, 2, 2))) @ strides
        x, y, z = np.stack([1.0 - share, share], axis=-1).transpose(1, 0, 2)
        weights = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return numbers, weights.reshape(-1, 8)

    def read(self, field: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return a field (3, I, J, K) at points (n, 3) [m]: linear between nodes, and zero (n, 3) outside."""
        index = self.index(points).T
        return np.stack([ndimage.map_coordinates(part, index, order=1) for part in field], axis=-1)


def build_grid_around(points: np.ndarray, spacing: float, margin: float) -> Grid:
    """Return the grid of a spacing [m] round points (n, 3) [m], with a margin [m].

    Nodes lie at multiples of the spacing.
    """
    low = np.floor((points.min(axis=0) - margin) / spacing)
    high = np.ceil((points.max(axis=0) + margin) / spacing)
    i, j, k = (high - low).astype(int) + 1
    return Grid(spacing * low, spacing, (int(i), int(j), int(k)))

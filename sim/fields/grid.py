"""Regular grid along the patient's coordinate axes."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage


@dataclass(frozen=True, eq=False)
class Grid:
    """Grid with nodes at `origin` (3,) + `spacing` x (i, j, k) [m, RAS], for indices i, j, k below `shape`."""

    origin: np.ndarray
    spacing: float
    shape: tuple[int, int, int]

    @property
    def affine(self) -> np.ndarray:
        """Affine (4, 4) from indices to metres."""
        affine = np.diag([self.spacing] * 3 + [1.0])
        affine[:3, 3] = self.origin
        return affine

    def to_indices(self, points: np.ndarray) -> np.ndarray:
        """Return the fractional grid indices (..., 3) of points (..., 3) [m]."""
        return (points - self.origin) / self.spacing

    def compute_positions(self, node_numbers: np.ndarray) -> np.ndarray:
        """Return the positions (n, 3) [m] of nodes, given their numbers (n,) in the flattened grid."""
        return self.origin + self.spacing * np.stack(np.unravel_index(node_numbers, self.shape), axis=-1)

    def find_corners(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corner node numbers (n, 8) of the cells that contain points (n, 3) [m], and trilinear weights."""
        index = self.to_indices(points)
        first = np.clip(np.floor(index).astype(int), 0, np.array(self.shape) - 2)
        share, strides = index - first, np.array([self.shape[1] * self.shape[2], self.shape[2], 1])
        numbers = (first @ strides)[:, None] + np.array(list(np.ndindex(2, 2, 2))) @ strides
        x, y, z = np.stack([1.0 - share, share], axis=-1).transpose(1, 0, 2)
        weights = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return numbers, weights.reshape(-1, 8)

    def interpolate(self, field: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return values (n, 3) of a field (3, I, J, K) at points (n, 3) [m], interpolated trilinearly; zero outside."""
        index = self.to_indices(points).T
        return np.stack([ndimage.map_coordinates(part, index, order=1) for part in field], axis=-1)


def build_grid_around(points: np.ndarray, spacing: float, margin: float) -> Grid:
    """Return the grid with a `spacing` [m] that contains points (n, 3) [m] with a `margin` [m].

    The node coordinates are multiples of the spacing.
    """
    low = np.floor((points.min(axis=0) - margin) / spacing)
    high = np.ceil((points.max(axis=0) + margin) / spacing)
    i, j, k = (high - low).astype(int) + 1
    return Grid(spacing * low, spacing, (int(i), int(j), int(k)))

"""Voxel mask of the interior of a closed surface."""

import numpy as np

from ..errors import InputError

RAY_OFFSET = np.array([3.37e-5, 7.13e-5])
"""Offset of the rays from the voxel centres [voxels], so that no ray hits an edge of grid-aligned triangles."""


def rasterise_interior(points: np.ndarray, triangles: np.ndarray, voxel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask (I, J, K) of the voxels with centre inside a surface, and its affine (4, 4); edge `voxel_size` [m].

    The surface has vertices (n, 3) [m] and triangles (m, 3) of any orientation. A centre is inside if a ray along z to
    this centre crosses the surface an odd number of times.

    Raises
    ------
    InputError
        The surface is not closed: an edge does not belong to exactly two triangles.
    """
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if (np.unique(edges, axis=0, return_counts=True)[1] != 2).any():
        raise InputError("the surface is not closed: give one without holes.")
    low = np.floor(points.min(axis=0) / voxel_size) - 1.0
    shape = (np.ceil(points.max(axis=0) / voxel_size) - low + 2.0).astype(int)
    corners = (points / voxel_size - low)[triangles]
    corners[..., :2] += RAY_OFFSET
    column, height = _find_crossings(corners)
    first, changes = np.clip(np.ceil(height).astype(int), 0, shape[2] - 1), np.zeros(shape, np.int32)
    np.add.at(changes, (column[:, 0], column[:, 1], first), 1)
    affine = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
    affine[:3, 3] = voxel_size * low
    return np.cumsum(changes, axis=2) % 2 == 1, affine


def _find_crossings(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the voxel columns (r, 2) of rays along z that hit a triangle (m, 3, 3) [voxels], and the heights (r,)."""
    low = np.ceil(corners[..., :2].min(axis=1)).astype(int)
    extent = np.maximum(np.floor(corners[..., :2].max(axis=1)).astype(int) - low + 1, 0)
    count = extent.prod(axis=1)
    owner = np.repeat(np.arange(len(corners)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    column = low[owner] + np.stack([number // extent[owner, 1], number % extent[owner, 1]], axis=1)
    a, b, c = (corners[owner, corner] for corner in range(3))
    ab, ac, at = (b - a)[:, :2], (c - a)[:, :2], column - a[:, :2]
    area = _compute_cross_products(ab, ac)
    flat = area == 0.0
    area = np.where(flat, 1.0, area)
    to_b, to_c = _compute_cross_products(at, ac) / area, _compute_cross_products(ab, at) / area
    met = ~flat & (to_b >= 0.0) & (to_c >= 0.0) & (to_b + to_c <= 1.0)
    height = a[:, 2] + to_b * (b - a)[:, 2] + to_c * (c - a)[:, 2]
    return column[met], height[met]


def _compute_cross_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

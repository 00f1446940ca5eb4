"""Interpolation of vertex values in tetrahedra to the nodes of a grid."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .grid import Grid

# Grid lines per block, to limit memory.
BLOCK_LINES = 500_000
# Tolerance of the inside test [spacings], so that nodes on a face belong to both sides.
INSIDE_TOLERANCE = 1e-7


class _Hits(NamedTuple):
    """Grid nodes inside tetrahedra: node number (n,), tetrahedron (n,), weights (n, 3) of its last three corners."""

    node: np.ndarray
    tet: np.ndarray
    weights: np.ndarray


def interpolate_in_tetrahedra(
    grid: Grid, nodes: np.ndarray, tets: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate `values` (V, 3) at vertices `nodes` (V, 3) [m] to grid nodes, linearly in each tetrahedron (T, 4).

    Return the field (3, I, J, K) float32, which is zero outside the mesh, and a mask (I, J, K) of the nodes inside.
    """
    count = int(np.prod(grid.shape))
    field, inside = np.zeros((3, count), np.float32), np.zeros(count, bool)
    first, slopes = values[tets[:, 0]], values[tets[:, 1:]] - values[tets[:, :1]]
    for hits in _iterate_hits(grid.shape, grid.to_indices(nodes[tets])):
        field[:, hits.node] = (first[hits.tet] + np.einsum("nc,nci->ni", hits.weights, slopes[hits.tet])).T
        inside[hits.node] = True
    return field.reshape(3, *grid.shape), inside.reshape(grid.shape)


def _iterate_hits(shape: tuple[int, int, int], corners: np.ndarray) -> Iterator[_Hits]:
    """Yield blocks of the grid nodes inside tetrahedra with corners (T, 4, 3) [indices], line by line."""
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # barycentric
    slack = INSIDE_TOLERANCE * np.linalg.norm(gradients, axis=2)
    low = np.maximum(np.ceil(corners.min(axis=1) - INSIDE_TOLERANCE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + INSIDE_TOLERANCE), np.array(shape) - 1).astype(np.int64)
    sides = np.maximum(high - low + 1, 0)
    sizes = sides[:, 0] * sides[:, 1] * (sides[:, 2] > 0)
    ends, begin = np.cumsum(sizes), 0
    at_first = np.einsum("tci,ti->tc", gradients, -corners[:, 0])
    at_first[:, 0] += 1.0
    while begin < len(corners):
        done = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, done + BLOCK_LINES, side="right")))
        some = slice(begin, end)
        tet = np.repeat(np.arange(begin, end), sizes[some])
        i, j = np.divmod(np.arange(len(tet)) - np.repeat(ends[some] - sizes[some] - done, sizes[some]), sides[tet, 1])
        i, j = i + low[tet, 0], j + low[tet, 1]
        weights = at_first[tet] + gradients[tet, :, 0] * i[:, None] + gradients[tet, :, 1] * j[:, None]
        slope = gradients[tet, :, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = -(weights + slack[tet]) / slope
        lowest = np.where(slope > 0.0, cut, -np.inf).max(axis=1)
        highest = np.where(slope < 0.0, cut, np.inf).min(axis=1)
        apart = ((slope == 0.0) & (weights < -slack[tet])).any(axis=1)
        from_k = np.maximum(np.ceil(lowest), low[tet, 2])
        count = np.where(apart, 0, np.maximum(np.minimum(np.floor(highest), high[tet, 2]) - from_k + 1, 0)).astype(int)
        line = np.repeat(np.arange(len(tet)), count)
        k = from_k[line].astype(np.int64) + np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
        yield _Hits(
            (i[line] * shape[1] + j[line]) * shape[2] + k, tet[line], weights[line, 1:] + slope[line, 1:] * k[:, None]
        )
        begin = end

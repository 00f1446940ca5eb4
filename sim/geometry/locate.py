"""Tetrahedron and barycentric weights of points, to interpolate a solution from one mesh to another mesh."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from .tetmesh import TetMesh

FIRST_CANDIDATES = 4  # Nearest tetrahedra that are tested first: they contain 97 % of points.
WEIGHT_TOLERANCE = 1e-12  # Barycentric weights below this are round-off.


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """Points in a mesh: vertices (n, 4) of the tetrahedron that contains each point, and barycentric weights (n, 4)."""

    vertices: np.ndarray
    weights: np.ndarray

    def interpolate(self, field: np.ndarray) -> np.ndarray:
        """Return values (B, n, k) at the points, by linear interpolation of values (B, V, k) at the vertices."""
        return np.einsum("nc,bnck->bnk", self.weights, field[:, self.vertices])


def locate(mesh: TetMesh, points: np.ndarray, candidates: int = 64) -> LocatedPoints:
    """Return tetrahedra and weights of points (n, 3) [m]; weights are clipped to a near element for outside points.

    The search uses the tetrahedra with the nearest centroids; the default of 64 `candidates` suffices in graded meshes.
    """
    tet, weights = _choose_tetrahedra(mesh, points, min(FIRST_CANDIDATES, candidates))
    unheld = np.flatnonzero(weights.min(axis=1) < -WEIGHT_TOLERANCE)
    tet[unheld], weights[unheld] = _choose_tetrahedra(mesh, points[unheld], candidates)
    inside = np.where(weights > WEIGHT_TOLERANCE, weights, 0.0)
    return LocatedPoints(mesh.tets[tet], inside / inside.sum(axis=1, keepdims=True))


class _Cells(NamedTuple):
    """Search data of a mesh: centroids, first corners (T, 3) [m], and inverses (T, 3, 3) [1/m] of edge matrices.

    An inverse maps a position relative to the first corner to the barycentric weights of the other three corners.
    """

    centroids: KDTree
    first_corners: np.ndarray
    inverse_edges: np.ndarray


@lru_cache(maxsize=4)
def _build_cells(mesh: TetMesh) -> _Cells:
    corners = mesh.nodes[mesh.tets]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return _Cells(KDTree(corners.mean(axis=1)), corners[:, 0], np.linalg.inv(edges))


def _choose_tetrahedra(mesh: TetMesh, points: np.ndarray, candidates: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra (n,) with the largest minimum weight among the nearest `candidates`, and weights (n, 4)."""
    cells, count = _build_cells(mesh), min(candidates, len(mesh.tets))
    near = cells.centroids.query(points, k=count)[1].reshape(len(points), count)
    inner = np.einsum("nkij,nkj->nki", cells.inverse_edges[near], points[:, None] - cells.first_corners[near])
    weights = np.concatenate([1.0 - inner.sum(axis=-1, keepdims=True), inner], axis=-1)
    best, row = weights.min(axis=-1).argmax(axis=1), np.arange(len(points))
    return near[row, best], weights[row, best]

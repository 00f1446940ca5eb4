"""Reading one mesh's answer at material points of another: which tetrahedron holds a point, and where in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from .tetmesh import TetMesh

# Tetrahedra that are looked at first: 97 of 100 points are in one of them. Weights below this are rounding.
FIRST, ROUNDING = 4, 1e-12


@dataclass(frozen=True, eq=False)
class Located:
    """Points in a mesh: vertices (n, 4) of the tetrahedron that holds each, and barycentric weights (n, 4)."""

    vertices: np.ndarray
    weights: np.ndarray

    def read(self, field: np.ndarray) -> np.ndarray:
        """Values (B, n, k) at the points, linear between the vertices' (B, V, k)."""
        return np.einsum("nc,bnck->bnk", self.weights, field[:, self.vertices])


def locate(mesh: TetMesh, points: np.ndarray, candidates: int = 64) -> Located:
    """Find points (n, 3) [m]; one outside is read at the place nearest to it by barycentric coordinates.

    In graded meshes the tetrahedron that holds a point is among the 64 `candidates` whose middles are nearest to it.
    """
    tet, weights = _best(mesh, points, min(FIRST, candidates))
    unheld = np.flatnonzero(weights.min(axis=1) < -ROUNDING)
    tet[unheld], weights[unheld] = _best(mesh, points[unheld], candidates)
    inside = np.where(weights > ROUNDING, weights, 0.0)
    return Located(mesh.tets[tet], inside / inside.sum(axis=1, keepdims=True))


class _Cells(NamedTuple):
    """The middles of a mesh's tetrahedra, their first corners (T, 3) [m], and inverses (T, 3, 3) [1/m] of their edges.

    An inverse makes barycentric weights of the other corners from how far a point is from the first.
    """

    middles: KDTree
    corner: np.ndarray
    inverse: np.ndarray


@lru_cache(maxsize=4)
def _cells(mesh: TetMesh) -> _Cells:
    corners = mesh.nodes[mesh.tets]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return _Cells(KDTree(corners.mean(axis=1)), corners[:, 0], np.linalg.inv(edges))


def _best(mesh: TetMesh, points: np.ndarray, candidates: int) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra (n,), of so many near points (n, 3) [m], that these are least outside of, and weights (n, 4) there."""
    cells, count = _cells(mesh), min(candidates, len(mesh.tets))
    near = cells.middles.query(points, k=count)[1].reshape(len(points), count)
    inner = np.einsum("nkij,nkj->nki", cells.inverse[near], points[:, None] - cells.corner[near])
    weights = np.concatenate([1.0 - inner.sum(axis=-1, keepdims=True), inner], axis=-1)
    best = weights.min(axis=-1).argmax(axis=1)
    row = np.arange(len(points))
    return near[row, best], weights[row, best]

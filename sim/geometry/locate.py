"""Reading one mesh's answer at material points of another: which tetrahedron holds a point, and where in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

from .tetmesh import TetMesh


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
    _, near = _middles(mesh).query(points, k=min(candidates, len(mesh.tets)))
    near = near.reshape(len(points), -1)
    a, *others = np.moveaxis(mesh.nodes[mesh.tets[near]], 2, 0)
    edges = np.stack([other - a for other in others], axis=-1)
    inner = np.linalg.solve(edges, (points[:, None] - a)[..., None])[..., 0]
    weights = np.concatenate([1.0 - inner.sum(axis=-1, keepdims=True), inner], axis=-1)
    best = weights.min(axis=-1).argmax(axis=1)
    row = np.arange(len(points))
    inside = np.maximum(weights[row, best], 0.0)
    return Located(mesh.tets[near[row, best]], inside / inside.sum(axis=1, keepdims=True))


@lru_cache(maxsize=4)
def _middles(mesh: TetMesh) -> KDTree:
    """The middles of a mesh's tetrahedra."""
    return KDTree(mesh.nodes[mesh.tets].mean(axis=1))

"""Fine surface embedded in a coarse one, by constant barycentric weights and depths along the coarse normals."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from scipy import sparse

from .layer import compute_vertex_normals
from .parallel import forward_kernel, launch_in_bands, load_modules


@forward_kernel
def embed_vertices(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, corners: wp.array(dtype=wp.vec3i),
    weights: wp.array(dtype=wp.vec3d), depth: wp.array(dtype=wp.float64), coarse: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d), rounding: wp.float64, max_height: wp.float64,
    # output
    fine: wp.array(dtype=wp.vec3d),
):  # fmt: skip
    """Compute fine vertices above the coarse facets, at the height of the rounded facet minus the vertex's depth."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        c, w = corners[index], weights[index]
        p = w[0] * coarse[c[0]] + w[1] * coarse[c[1]] + w[2] * coarse[c[2]]
        normal = wp.vec3d(wp.float64(0.0))
        away = wp.vec3d(wp.float64(0.0))
        for k in range(3):
            n = normals[c[k]]
            normal += w[k] * n
            away -= w[k] * wp.dot(p - coarse[c[k]], n) * n
        normal = wp.normalize(normal)
        height = rounding * wp.dot(away, normal) - depth[index]
        fine[index] = p + wp.min(height, max_height) * normal


@dataclass(frozen=True, eq=False)
class EmbeddedSurface:
    """Fine surface that follows a coarse surface, by default never outside the coarse facets.

    A fine vertex is the interpolated coarse point, moved along the interpolated normal by the rounded facet's height
    minus the vertex's depth.

    Parameters
    ----------
    coarse
        Triangles (S, 3) of the coarse surface.
    corners, weights
        Coarse vertices (m, 3) that each fine vertex depends on, and their barycentric weights (m, 3).
    triangles
        Triangles (F, 3) of the fine surface.
    depth
        Depth (m,) [m] of each fine vertex below the rounded coarse surface.
    rounding
        Share of Phong tessellation (Boubekeur, Alexa 2008) that rounds the coarse facets; 0.5 makes a circle round.
    max_height
        Largest height [m] of fine vertices above the coarse facets.
    """

    coarse: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray
    depth: np.ndarray
    rounding: float = 0.75
    max_height: float = 0.0

    @cached_property
    def _inputs(self) -> list[wp.array]:
        kinds = wp.vec3i, wp.vec3d, wp.float64
        arrays = self.corners.astype(np.int32), self.weights, self.depth
        load_modules("cpu", embed_vertices.module)
        return [wp.array(array, dtype=kind, device="cpu") for array, kind in zip(arrays, kinds, strict=True)]

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values (n, ...) at the coarse vertices to values (m, ...) at the fine vertices."""
        return np.einsum("mk,mk...->m...", self.weights, values[self.corners])

    def compute_vertices(self, positions: np.ndarray) -> np.ndarray:
        """Compute the fine vertices (m, 3) [m] for positions (n, 3) [m] of the coarse vertices."""
        both = positions, compute_vertex_normals(positions, self.coarse)
        coarse = [wp.array(np.ascontiguousarray(each), dtype=wp.vec3d, device="cpu") for each in both]
        fine = wp.empty(len(self.depth), dtype=wp.vec3d, device="cpu")
        launch_in_bands(
            embed_vertices, [*self._inputs, *coarse, self.rounding, self.max_height], [fine], len(self.depth), "cpu"
        )
        return fine.numpy()


def build_embedded_surface(
    points: np.ndarray, triangles: np.ndarray, edge_length: Callable[[np.ndarray], np.ndarray]
) -> EmbeddedSurface:
    """Subdivide triangles (S, 3) of points (n, 3) [m] until no edge exceeds `edge_length` [m] at its centre.

    `edge_length` maps centres (e, 3) [m] to lengths (e,). Depths are zero. Neighbouring triangles share vertices.
    """
    coarse, at = triangles, points
    shares = sparse.csr_matrix(sparse.identity(len(points)))
    while True:
        ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        keys, number = np.unique(ends @ [len(at), 1], return_inverse=True)
        a, b = np.divmod(keys, len(at))
        long = np.linalg.norm(at[a] - at[b], axis=1) > edge_length(0.5 * (at[a] + at[b]))
        if not long.any():
            break
        new = np.where(long, len(at) + np.cumsum(long) - 1, -1)
        triangles = _split_triangles(triangles, new[number].reshape(-1, 3))
        shares = sparse.csr_matrix(sparse.vstack([shares, 0.5 * (shares[a[long]] + shares[b[long]])]))
        at = shares @ points
    row = np.repeat(np.arange(len(at)), np.diff(shares.indptr))
    place = row, np.arange(len(row)) - shares.indptr[row]
    corners, weights = np.zeros((len(at), 3), np.int64), np.zeros((len(at), 3))
    corners[place], weights[place] = shares.indices, shares.data
    # Neighbours are adjacent in memory, so that drawing takes less time.
    order = np.lexsort([*weights.T, *np.sort(corners, axis=1).T])
    triangles = np.argsort(order)[triangles]
    triangles = triangles[np.argsort(triangles.min(axis=1))]
    return EmbeddedSurface(coarse, corners[order], weights[order], triangles, np.zeros(len(at)))


def _split_triangles(triangles: np.ndarray, midpoints: np.ndarray) -> np.ndarray:
    """Split triangles (F, 3) at new vertices `midpoints` (F, 3) on their edges ab, bc, ca; -1: none."""
    count = (midpoints >= 0).sum(axis=1)
    # One divided edge comes first, one whole edge last.
    first = np.select([count == 1, count == 2], [np.argmax(midpoints, axis=1), np.argmin(midpoints, axis=1) + 1], 0)
    turn = (first[:, None] + np.arange(3)) % 3
    (a, b, c), (m, n, o) = (np.take_along_axis(each, turn, axis=1).T for each in (triangles, midpoints))
    pieces = {
        0: [(a, b, c)],
        1: [(a, m, c), (m, b, c)],
        2: [(m, b, n), (a, m, n), (a, n, c)],
        3: [(a, m, o), (m, b, n), (o, n, c), (m, n, o)],
    }
    return np.concatenate([np.stack(each, axis=1)[count == of] for of, some in pieces.items() for each in some])

"""Extrapolation of the displacement field of a mesh to points just outside its surface."""

import numpy as np
from scipy.spatial import KDTree

from ..geometry.closest_point import find_closest_points
from ..geometry.tetmesh import find_boundary_faces

CANDIDATE_TRIANGLES = 16  # candidate triangles for the closest point
BLOCK_SIZE = 4096  # points per block
MAX_CHANGE_FRACTION = 0.5  # maximum extrapolated change, as a fraction of the surface value: zero stays zero
MIN_DIVISOR = 1e-30  # guard against division by 0


def extrapolate_beyond_surface(
    nodes: np.ndarray, tets: np.ndarray, values: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return values (n, 3) at points (n, 3) [m] near the surface of a mesh, from `values` (V, 3) at its vertices.

    The value of a point is that of the closest surface point plus a linear extrapolation. The gradient is the mean over
    the tetrahedra around each vertex; the extrapolation is limited to half of the surface value.
    """
    surface = find_boundary_faces(tets)
    corners, slopes = nodes[surface], compute_vertex_gradients(nodes, tets, values)
    middles, found = KDTree(corners.mean(axis=1)), np.empty((len(points), 3))
    for first in range(0, len(points), BLOCK_SIZE):
        some = slice(first, first + BLOCK_SIZE)
        near = middles.query(points[some], k=min(CANDIDATE_TRIANGLES, len(surface)))[1].reshape(len(points[some]), -1)
        place, which, weights = find_closest_points(points[some], corners[near])
        vertices = surface[near[np.arange(len(near)), which]]
        gradient = np.einsum("nc,ncij->nij", weights, slopes[vertices])
        level = np.einsum("nc,nci->ni", weights, values[vertices])
        change = np.einsum("nij,nj->ni", gradient, points[some] - place)
        size, most = (np.linalg.norm(values, axis=1, keepdims=True) for values in (change, MAX_CHANGE_FRACTION * level))
        found[some] = level + change * np.minimum(1.0, most / np.maximum(size, MIN_DIVISOR))
    return found


def compute_vertex_gradients(nodes: np.ndarray, tets: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return gradients (V, 3, 3) of `values` (V, 3): volume-weighted means over the tetrahedra around each vertex."""
    corners, at = nodes[tets], values[tets]
    edges = corners[:, 1:] - corners[:, :1]
    gradients = np.linalg.solve(edges, at[:, 1:] - at[:, :1]).transpose(0, 2, 1)
    volume = np.abs(np.linalg.det(edges))
    total, size = np.zeros((len(nodes), 3, 3)), np.zeros(len(nodes))
    for corner in tets.T:
        np.add.at(total, corner, volume[:, None, None] * gradients)
        np.add.at(size, corner, volume)
    return total / np.where(size > 0.0, size, 1.0)[:, None, None]

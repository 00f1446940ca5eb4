"""Triangulated surfaces: areas, which way they face, and whether points lie inside a closed one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BlurRange:
    """How far a blur of a surface reaches, and how narrow it may be.

    Parameters
    ----------
    reach
        Standard deviations of the blur, beyond which nothing counts.
    narrowest
        The narrowest blur, as a share of the longest edge: every corner has the middle of a triangle within two thirds
        of that edge.
    together
        Points whose surroundings are summed at once: bounds the memory that it takes.
    """

    reach: float = 3.5
    narrowest: float = 0.25
    together: int = 2_000


def compute_blurred_normals(
    nodes: np.ndarray, triangles: np.ndarray, points: np.ndarray, blur: float, limits: BlurRange = BlurRange()
) -> np.ndarray:
    """Return unit normals (n, 3) at points (n, 3) [m] of the body within outward triangles (S, 3), seen through a blur.

    They are the gradient of the body's indicator after a Gaussian of standard deviation `blur` [m]. By the divergence
    theorem that is the integral over its surface of the Gaussian times the inward normal. Of folds narrower than the
    blur nothing is left, and the finer the mesh, the less the normals depend on it. Triangles that are so wide that
    none of their middles need be in sight of a corner are seen through a wider blur, a share of their longest edge.
    """
    from scipy.spatial import KDTree  # takes a tenth of a second, and help texts need none of it

    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max()
    blur = max(blur, limits.narrowest * longest)
    twice, middle = np.cross(b - a, c - a), KDTree((a + b + c) / 3.0)
    out = np.zeros_like(points)
    for first in range(0, len(points), limits.together):
        some = slice(first, first + limits.together)
        near = (
            KDTree(points[some]).sparse_distance_matrix(middle, limits.reach * blur, output_type="coo_matrix").tocsr()
        )
        near.data = np.exp(-0.5 * (near.data / blur) ** 2)
        out[some] = near @ twice
    return normalise_vectors(out)


def compute_vertex_normals(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) at nodes (V, 3) [m] of outward triangles (S, 3): their area-weighted mean; zero off them."""
    corners = nodes[triangles]
    twice = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(nodes)
    for corner in triangles.T:
        np.add.at(total, corner, twice)
    return normalise_vectors(total)


def normalise_vectors(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) at unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def is_enclosing(corners: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed surface of triangles with corners (S, 3, 3) [m] has a point (3,) [m] inside it.

    By its winding number: the solid angles of all triangles add up to a whole turn or to none, whichever way they face.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    x, y, z = (np.linalg.norm(arm, axis=1) for arm in (a, b, c))
    volume = np.einsum("si,si->s", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("si,si->s", one, other) for one, other in ((a, b), (b, c), (c, a)))
    half = np.arctan2(volume, x * y * z + ab * z + bc * x + ca * y)
    return bool(abs(half.sum()) > np.pi)


def compute_edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Of each edge (S, 3) [m] of triangles with corners (S, 3, 3) [m]."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def compute_areas(corners: np.ndarray) -> np.ndarray:
    """(S,) [m^2] of triangles with corners (S, 3, 3) [m]."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def compute_vertex_areas(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return a third (n,) [m^2] of the areas of the triangles (S, 3) at each of the nodes (n, 3) [m]."""
    return np.bincount(triangles.ravel(), np.repeat(compute_areas(nodes[triangles]) / 3.0, 3), len(nodes))

"""Triangulated surfaces: areas, normals, and a test if a closed surface contains a point."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BlurRange:
    """Options for normals of a blurred surface.

    Parameters
    ----------
    cutoff
        Cut-off radius [standard deviations of the blur].
    min_blur_ratio
        Minimum blur, as a fraction of the longest edge, since the centroid of a triangle may be up to two thirds of
        an edge away from a corner.
    block_size
        Number of points computed at once, which limits memory.
    """

    cutoff: float = 3.5
    min_blur_ratio: float = 0.25
    block_size: int = 2_000


def compute_blurred_normals(
    nodes: np.ndarray, triangles: np.ndarray, points: np.ndarray, blur: float, limits: BlurRange = BlurRange()
) -> np.ndarray:
    """Return outward unit normals (n, 3) at points (n, 3) [m] of a blurred solid bounded by outward triangles (S, 3).

    The normal is the negative gradient of the indicator function of the solid, blurred by a Gaussian with standard
    deviation `blur` [m]. By the divergence theorem, this is the surface integral of the Gaussian times the outward
    normal. Folds narrower than the blur disappear, and normals on fine meshes do not depend on the mesh. If triangles
    are too large for the blur, it is increased to a fraction of the longest edge.
    """
    from scipy.spatial import KDTree  # slow to import, and not needed for help texts

    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max()
    blur = max(blur, limits.min_blur_ratio * longest)
    twice, middle = np.cross(b - a, c - a), KDTree((a + b + c) / 3.0)
    out = np.zeros_like(points)
    for first in range(0, len(points), limits.block_size):
        some = slice(first, first + limits.block_size)
        near = (
            KDTree(points[some]).sparse_distance_matrix(middle, limits.cutoff * blur, output_type="coo_matrix").tocsr()
        )
        near.data = np.exp(-0.5 * (near.data / blur) ** 2)
        out[some] = near @ twice
    return normalise_vectors(out)


def compute_vertex_normals(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return area-weighted unit normals (V, 3) at nodes (V, 3) [m] of outward triangles (S, 3); zero at other nodes."""
    corners = nodes[triangles]
    twice = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(nodes)
    for corner in triangles.T:
        np.add.at(total, corner, twice)
    return normalise_vectors(total)


def normalise_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) scaled to unit length; zero vectors remain zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def is_enclosing(corners: np.ndarray, point: np.ndarray) -> bool:
    """Return True if a closed surface of triangles with corners (S, 3, 3) [m] contains a point (3,) [m].

    The test uses the winding number: the solid angles of the triangles sum to +-4 pi inside and to 0 outside.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    x, y, z = (np.linalg.norm(arm, axis=1) for arm in (a, b, c))
    volume = np.einsum("si,si->s", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("si,si->s", one, other) for one, other in ((a, b), (b, c), (c, a)))
    half = np.arctan2(volume, x * y * z + ab * z + bc * x + ca * y)
    return bool(abs(half.sum()) > np.pi)


def compute_edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Compute the length of each edge (S, 3) [m] of triangles with corners (S, 3, 3) [m]."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def compute_areas(corners: np.ndarray) -> np.ndarray:
    """Compute the areas (S,) [m^2] of triangles with corners (S, 3, 3) [m]."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def compute_vertex_areas(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the nodal areas (n,) [m^2]: one third of the area of the triangles (S, 3) at each node (n, 3) [m]."""
    return np.bincount(triangles.ravel(), np.repeat(compute_areas(nodes[triangles]) / 3.0, 3), len(nodes))

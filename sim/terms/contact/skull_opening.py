"""Where bone ends: how far points of a brain's surface are inside its opening, and which way that is."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.special import ndtri

from ...anatomy import Anatomy
from ...geometry.normals import REACH, unit
from ...geometry.triangles import edge_lengths

# Blurs from the edge, beyond which too little of it is seen.
FAR = 2.5


def rim_of(anatomy: Anatomy) -> np.ndarray:
    """Surface triangles (R, 3) that the edge of the craniotomy crosses: part open, part under bone."""
    around = anatomy.mesh.surface[about_opening(anatomy)]
    opened = anatomy.craniotomy[around]
    return around[opened.any(axis=1) & ~opened.all(axis=1)]


def edge_of(nodes: np.ndarray, rim: np.ndarray) -> float:
    """How round [m] an edge looks across triangles (R, 3) of nodes (V, 3) [m]: as theirs are long, on average."""
    return float(edge_lengths(nodes[rim]).mean())


def inside_opening(
    anatomy: Anatomy, points: np.ndarray, normal: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far (n,) [m] points (n, 3) [m] of the surface are inside the craniotomy, and which way its middle is (n, 3).

    Negative under bone. The way is of unit length and across the points' unit normals (n, 3); it is zero more than two
    and a half blurs from the edge.

    Of a straight edge a Gaussian of standard deviation `blur` [m] leaves the share Phi(r / blur) of what is open to a
    point that is r inside: that is inverted.
    """
    mesh, opened = anatomy.mesh, anatomy.craniotomy
    triangles = mesh.surface[about_opening(anatomy)]
    a, b, c = np.moveaxis(mesh.nodes[triangles], 1, 0)
    twice, middle, bare = np.cross(b - a, c - a), (a + b + c) / 3.0, opened[triangles].mean(axis=1)
    seen = KDTree(points).sparse_distance_matrix(KDTree(middle), REACH * blur, output_type="coo_matrix")
    # The other side of a thin body is not seen.
    facing = np.einsum("ki,ki->k", normal[seen.row], twice[seen.col]).clip(0.0)
    seen.data = facing * np.exp(-0.5 * (seen.data / blur) ** 2)
    seen = seen.tocsr()
    whole, part = seen @ np.ones(len(bare)), seen @ bare
    share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)
    # The share's gradient, but for a positive factor.
    uphill = seen @ (middle * bare[:, None]) - share[:, None] * (seen @ middle)
    across = unit(uphill - (uphill * normal).sum(axis=1, keepdims=True) * normal)
    inside = ndtri(share).clip(-FAR, FAR)
    return blur * inside, np.where(np.abs(inside[:, None]) < FAR, across, 0.0)


def about_opening(anatomy: Anatomy) -> np.ndarray:
    """(S,) bool: surface triangles whose corners all lie in the craniotomy or under bone."""
    covered = np.logical_or(anatomy.slide_normal.any(axis=1), anatomy.held.all(axis=1))
    return np.all(np.logical_or(anatomy.craniotomy, covered)[anatomy.mesh.surface], axis=1)

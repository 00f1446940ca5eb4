"""Element-free Galerkin method: moving least squares at the mesh vertices, with tetrahedra as integration cells.

Belytschko, Lu, Gu 1994, "Element-free Galerkin methods", Int. J. Numer. Meth. Eng. 37:229-256. For the brain, in the
undeformed configuration: Horton, Wittek, Joldes, Miller 2010, Int. J. Numer. Meth. Biomed. Eng. 26:977-998. Each cell
has one gradient, its volume average, computed as an integral over the faces; so linear patch tests are exact (Chen, Wu,
Yoon, You 2001, "A stabilized conforming nodal integration for Galerkin mesh-free methods", Int. J. Numer. Meth. Eng.
50:435-466, here with tetrahedra instead of Voronoi cells).
"""

import numpy as np
import scipy.sparse as sp

from ..geometry.tetmesh import FACES, TetMesh, compute_row_keys
from .element import Elements, pack_gradients

MAX_SUPPORT = 12  # Maximum number of nodes that determine the displacement of a face.
STEPS = 2  # Steps across faces from the tetrahedra of a face to the farthest ones whose vertices may support it.
REGULARISATION = 1e-5  # Smallest square distance from a node, relative to the support radius, that changes its weight.
STABILISATION = 0.1  # Share of linear interpolation on a face: stiffens oscillations that moving averages miss.
RADIUS = 1.1  # Support radius, relative to the distance of the farthest node of the support.


def build_element_free(mesh: TetMesh, tet_mask: np.ndarray) -> Elements:
    """Return one integration cell for each tetrahedron marked in `tet_mask` (T,).

    grad N_a = 1/V sum over faces of N_a(centroid) n A. Adjacent cells use the same N_a at a common face, so gradients
    sum to the surface integral of N_a n. At outer surfaces and region interfaces, N_a = 1/3 at the three vertices of a
    face: loads and fixed nodes act as on linear tetrahedra, strain may jump, and no support crosses such a face.
    """
    tets = mesh.tets[tet_mask]
    corner = tets[:, FACES].reshape(-1, 3)
    _, first, face = np.unique(compute_row_keys(corner), return_index=True, return_inverse=True)
    cell = np.repeat(np.arange(len(tets)), len(FACES))
    # Faces with a tetrahedron of the same region on both sides.
    label = np.unique(mesh.region[tet_mask], return_inverse=True)[1][cell]
    count, total, square = (np.bincount(face, label**power) for power in range(3))
    inside = (count == 2) & (total**2 == 2.0 * square)
    across, corners = inside[face], corner[first]
    table, shape = np.full((len(first), 3 + MAX_SUPPORT), -1), np.zeros((len(first), 3 + MAX_SUPPORT))
    table[:, :3], shape[:, :3] = corners, np.where(inside, STABILISATION, 1.0)[:, None] / 3.0
    links = sp.csr_array((np.ones(across.sum(), bool), (face[across], cell[across])), (len(first), len(tets)))
    support = _choose_supports(mesh.nodes, tets, sp.csr_array(links[inside]), corners[inside])
    centroid = mesh.nodes[corners[inside]].mean(axis=1)
    own = compute_shape_functions(centroid, mesh.nodes[support], support >= 0)
    table[inside, 3:], shape[inside, 3:] = support, (1.0 - STABILISATION) * own
    a, b, c = np.moveaxis(mesh.nodes[corner], 1, 0)
    area = np.cross(b - a, c - a) / (2.0 * mesh.volumes[tet_mask][cell, None])
    entry, column = np.nonzero(table[face] >= 0)
    slope = area[entry] * shape[face[entry], column][:, None]
    nodes, size, gradient = pack_gradients(cell[entry], table[face[entry], column], slope)
    weight = mesh.volumes[tet_mask][:, None]
    return Elements(nodes, gradient, weight, len(mesh.nodes), np.flatnonzero(tet_mask), tets, size)


def compute_shape_functions(points: np.ndarray, nodes: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return shape functions (m, k) at points (m, 3) [m] with support `nodes` (m, k, 3) [m] marked in `mask` (m, k).

    N_a = w_a p_a^T M^-1 p(x), M = sum of w_a p_a p_a^T, p = (1, x - x_a): linear fields are reproduced. The weight
    w = ((s^2 + e)^-2 - (1 + e)^-2) / (e^-2 - (1 + e)^-2) at distance s, relative to the support radius, makes
    N_a(x_b) = 1 if a = b, else 0, to about 1e-6: Most, Bucher 2005, "A moving least squares weighting function for the
    element-free Galerkin method which almost fulfills essential boundary conditions", Struct. Eng. Mech. 21:315-332.
    """
    away = np.where(mask[..., None], nodes - points[:, None], 0.0)
    radius = RADIUS * np.linalg.norm(away, axis=2).max(axis=1)
    away = away / radius[:, None, None]
    square, low, high = (away**2).sum(axis=2), (1.0 + REGULARISATION) ** -2, REGULARISATION**-2
    weight = np.where(mask, ((square + REGULARISATION) ** -2 - low) / (high - low), 0.0)
    weight /= weight.max(axis=1, keepdims=True)
    basis = np.concatenate([np.ones((*square.shape, 1)), away], axis=2)
    moment = np.einsum("ma,mai,maj->mij", weight, basis, basis)
    return weight * np.einsum("mai,mi->ma", basis, np.linalg.pinv(moment, 1e-12, hermitian=True)[:, 0])


def _choose_supports(nodes: np.ndarray, tets: np.ndarray, links: sp.csr_array, corner: np.ndarray) -> np.ndarray:
    """Return the `MAX_SUPPORT` vertices nearest to each face (m, 3), at most `STEPS` cells away; -1 if there are fewer.

    `links` (m, T) bool marks the two tetrahedra of each face.
    """
    incidence = sp.csr_array(
        (np.ones(tets.size, bool), tets.ravel(), np.arange(0, tets.size + 1, 4)), (len(tets), len(nodes))
    )
    reached = links
    for _ in range(STEPS):
        reached = reached + (reached @ links.T) @ links
    near = sp.csr_array(reached @ incidence)
    face = np.repeat(np.arange(len(corner)), np.diff(near.indptr))
    distance = np.linalg.norm(nodes[near.indices] - nodes[corner].mean(axis=1)[face], axis=1)
    order, rank = np.lexsort((distance, face)), np.arange(len(face)) - near.indptr[face]
    kept, out = rank < MAX_SUPPORT, np.full((len(corner), MAX_SUPPORT), -1)
    out[face[kept], rank[kept]] = near.indices[order][kept]
    return out

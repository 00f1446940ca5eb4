"""Removal of tetrahedra until a mesh is one component with a 2-manifold surface."""

import numpy as np
from scipy.sparse import coo_array, csgraph

from ..geometry.tetmesh import FACES, compute_row_keys


def find_largest_component(tets: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the tetrahedra in the largest face-connected component."""
    _, number, count = np.unique(
        compute_row_keys(tets[:, FACES].reshape(-1, 3)), return_inverse=True, return_counts=True
    )
    owner, order = np.repeat(np.arange(len(tets)), 4), np.argsort(number, kind="stable")
    pairs = owner[order[np.flatnonzero(count[number[order]] == 2)]].reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(tets), len(tets)))
    _, label = csgraph.connected_components(graph, directed=False)
    return label == np.bincount(label).argmax()


def select_manifold(tets: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of tetrahedra to keep; these form one component with a 2-manifold surface.

    The surface touches itself at an edge of more than two triangles, or at a node with more than one triangle fan. The
    tetrahedra behind these triangles are removed, except those behind the node's largest fan.
    """
    keep = np.ones(len(tets), bool)
    while True:
        keep[keep] = find_largest_component(tets[keep])
        offending = _find_pinching_tets(tets[keep])
        if len(offending) == 0:
            return keep
        keep[np.flatnonzero(keep)[offending]] = False


def _find_pinching_tets(tets: np.ndarray) -> np.ndarray:
    """Return the indices of the tetrahedra behind all triangle fans of a node except its largest fan."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(compute_row_keys(faces), return_index=True, return_counts=True)
    outer = np.sort(first[count == 1])
    surface, behind = faces[outer], outer // 4
    # One graph node per triangle corner; corners at one mesh node are linked across edges with exactly two triangles.
    corner = np.arange(3 * len(surface)).reshape(-1, 3)
    sides = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    ends = surface.ravel()[sides]
    turned = ends[:, 0] > ends[:, 1]
    sides[turned] = sides[turned][:, ::-1]
    _, edge, shared = np.unique(compute_row_keys(ends), return_inverse=True, return_counts=True)
    order = np.argsort(edge, kind="stable")
    pairs = sides[order[shared[edge[order]] == 2]].reshape(-1, 2, 2)
    joined = np.concatenate([pairs[:, :, 0], pairs[:, :, 1]])
    graph = coo_array((np.ones(len(joined), bool), (joined[:, 0], joined[:, 1])), shape=(corner.size, corner.size))
    _, fan = csgraph.connected_components(graph, directed=False)
    size, node = np.bincount(fan), np.zeros(fan.max() + 1, int)
    node[fan] = surface.ravel()
    order, lesser = np.lexsort((np.arange(len(size)), -size, node)), np.ones(len(size), bool)
    lesser[order[np.unique(node[order], return_index=True)[1]]] = False
    return np.unique(behind[lesser[fan.reshape(-1, 3)].any(axis=1)])


def find_removable_tetrahedra(tets: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Return a mask of the `candidates` tetrahedra (T,) whose removal leaves the surface a 2-manifold.

    A tetrahedron is removable if three of its faces are on the surface, or two faces if the edge between the other two
    faces is an interior edge. Only one of several tetrahedra that share a node is selected.
    """
    faces = tets[:, FACES].reshape(-1, 3)
    _, number, count = np.unique(compute_row_keys(faces), return_inverse=True, return_counts=True)
    outer, width = (count[number] == 1).reshape(-1, 4), int(tets.max()) + 1
    edges = np.sort(faces[outer.ravel()][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    surface_edges, removed = np.unique(edges @ [width, 1]), np.zeros(len(tets), bool)
    taken = np.zeros(width, bool)
    for tet in np.flatnonzero(candidates & (outer.sum(axis=1) >= 2)):
        hidden = tets[tet][outer[tet]]  # corners opposite outer faces: if two, the ends of the inner edge
        inner = len(hidden) == 3 or not np.isin(np.sort(hidden) @ [width, 1], surface_edges)
        if len(hidden) < 4 and inner and not taken[tets[tet]].any():
            removed[tet] = True
            taken[tets[tet]] = True
    return removed

"""Linear tetrahedra with strain averaged around edges and nodes, which avoids locking without additional nodes.

Selective edge- and node-based smoothing, "ES/NS-FEM-T4": Onishi, Amaya 2014, Int. J. Numer. Meth. Eng. 99:354-371,
after Liu, Nguyen-Thoi 2010, "Smoothed Finite Element Methods". The displacement gradient is averaged over the elements
around an edge, weighted by a sixth of their volumes, and determines the deviatoric response. The average over the
elements around a node, with a quarter of each, determines the volumetric response.
"""

import numpy as np

from ..geometry.tetmesh import EDGES, TetMesh, compute_row_keys
from .element import Elements, build_linear_elements, pack_gradients


def build_edge_elements(mesh: TetMesh, tet_mask: np.ndarray) -> Elements:
    """Return one element per edge and region, from the tetrahedra in `tet_mask` (T,) around the edge."""
    ends = np.sort(mesh.tets[tet_mask][:, EDGES].reshape(-1, 2))
    return _build_averaged_elements(mesh, tet_mask, compute_row_keys(ends).reshape(-1, len(EDGES)), ends)


def build_node_elements(mesh: TetMesh, tet_mask: np.ndarray) -> Elements:
    """Return one element per node and region, from the tetrahedra in `tet_mask` (T,) around the node."""
    corners = mesh.tets[tet_mask].astype(np.int64)
    return _build_averaged_elements(mesh, tet_mask, corners, corners.reshape(-1, 1))


def _build_averaged_elements(mesh: TetMesh, tet_mask: np.ndarray, key: np.ndarray, vertices: np.ndarray) -> Elements:
    """Return one element per distinct number in `key` (T, k); tetrahedron t adds V_t / k to each element it belongs to.

    `vertices` (T k, n) are the mesh vertices that identify each entry of `key`. Elements do not mix regions.
    """
    linear = build_linear_elements(mesh, tet_mask)
    count, lent = key.shape
    _, region = np.unique(mesh.region[tet_mask], return_inverse=True)
    key = key * (region.max(initial=0) + 1) + region[:, None]
    _, first, domain = np.unique(key.ravel(), return_index=True, return_inverse=True)
    share = np.repeat(linear.weight[:, 0] / lent, lent)
    volume = np.bincount(domain, share)
    # Every corner of every tetrahedron of a domain adds its gradient to the domain's entry for that node.
    tet = np.repeat(np.arange(count), lent)
    gradient = (share / volume[domain])[:, None, None] * linear.gradient[tet, 0]
    every = np.repeat(domain.ravel(), linear.table.shape[1])
    table, size, spread = pack_gradients(every, linear.table[tet].ravel(), gradient.reshape(-1, 3))
    owner = linear.owner[first // lent]
    marks = np.column_stack([vertices[first], mesh.region[owner]])
    return Elements(table, spread, volume[:, None], linear.node_count, owner, marks, size)

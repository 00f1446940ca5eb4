"""Rigid body modes: test that the constraints prevent rigid motion of all parts of a body."""

import numpy as np
import scipy.sparse as sp

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.tetmesh import FACES, TetMesh, compute_row_keys


def check_fixed(mesh: TetMesh, fixed: np.ndarray, normal: np.ndarray, tolerance: float = 1e-6) -> None:
    """Reject a mesh with a part that can translate or rotate freely.

    `fixed` (V, 3) bool and `normal` (V, 3) are the constraints. Nodes without an element must be fixed. Elements joined
    by faces form a rigid cluster; clusters with only a common corner or edge are hinged there. A rigid motion is
    resisted if its mean violation of the constraints exceeds a fraction `tolerance` of the motion.

    Raises
    ------
    InputError
        A part can move; the message describes the part and the missing constraints.
    """
    count = len(mesh.nodes)
    used = np.zeros(count, bool)
    used[mesh.table] = True
    loose = np.flatnonzero(~used & ~fixed.all(axis=1))
    if len(loose):
        raise InputError(f"node {loose[0]} (and {len(loose) - 1} more) belongs to no tetrahedron: remove or hold it.")
    key = np.unique(np.repeat(_label_clusters(mesh.tets), mesh.table.shape[1]) * count + mesh.table.ravel())
    cluster, node = divmod(key, count)
    piece = _label_components(cluster, cluster.max() + 1 + node, cluster.max() + 1 + count)[cluster]
    for number in np.unique(piece):
        mine = piece == number
        free, at = _count_free_motions(mesh.nodes, fixed, normal, cluster[mine], node[mine], tolerance)
        if free == 0:
            continue
        hinged, part = len(np.unique(cluster[mine])) > 1, node[mine & (cluster == at)]
        where = f"{len(part)} nodes round {np.round(1e3 * mesh.nodes[part].mean(axis=0), 1)} mm"
        if hinged:
            raise InputError(
                f"a part of {where} can move rigidly in {free} ways: it shares corners or an edge with the rest, but "
                "no face. Join it by faces, hold it, or remove it."
            )
        what = "the body" if len(part) == used.sum() else f"a loose piece of {where}"
        raise InputError(
            f"{what} can move rigidly in {free} of 6 ways: hold at least three nodes of it that are not in line, in "
            f"x, y and z{'' if len(part) == used.sum() else ', or give it common nodes with the body that it touches'}."
        )


def find_loose_tetrahedra(anatomy: Anatomy, can_slide: bool = True, tolerance: float = 1e-6) -> np.ndarray:
    """Return tetrahedra (n,) that can move rigidly despite fixed nodes and, if `can_slide`, slide normals."""
    normal = anatomy.slide_normal if can_slide else np.zeros_like(anatomy.slide_normal)
    cluster, nodes = _label_clusters(anatomy.mesh.tets), anatomy.mesh.nodes
    loose = []
    for number in np.unique(cluster):
        mine = np.flatnonzero(cluster == number)
        node = np.unique(anatomy.mesh.table[mine])
        if not anatomy.fixed[node].any():
            one = np.zeros(len(node), np.int64)
            if _count_free_motions(nodes, anatomy.fixed, normal, one, node, tolerance)[0]:
                loose.append(mine)
    return np.concatenate(loose) if loose else np.zeros(0, np.int64)


def _label_components(edge_starts: np.ndarray, edge_ends: np.ndarray, count: int) -> np.ndarray:
    """Return the connected component number (count,) of each vertex of a graph with edges (first, second)."""
    graph = sp.coo_array((np.ones(len(edge_starts)), (edge_starts, edge_ends)), shape=(count, count))
    return sp.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def _label_clusters(tets: np.ndarray) -> np.ndarray:
    """Return the cluster number (T,) of each element; elements with a common face belong to the same cluster."""
    keys = compute_row_keys(tets[:, FACES].reshape(-1, 3))
    order = np.argsort(keys)
    same = keys[order[1:]] == keys[order[:-1]]
    return _label_components(order[:-1][same] // 4, order[1:][same] // 4, len(tets))


def _count_free_motions(
    nodes: np.ndarray, fixed: np.ndarray, normal: np.ndarray, cluster: np.ndarray, node: np.ndarray, tolerance: float
) -> tuple[int, int]:
    """Return the number of unresisted rigid motions, and the cluster that moves most in one of them.

    `cluster` (m,) and `node` (m,) are pairs of a cluster and its node. Each cluster has six unknowns. The equations:
    fixed components and normals do not move, and a node moves equally in all its clusters.
    """
    names, local = np.unique(cluster, return_inverse=True)
    size = np.bincount(local)
    centre = np.column_stack([np.bincount(local, x) / size for x in nodes[node].T])
    arm = nodes[node] - centre[local]
    arm /= np.maximum.reduceat(np.linalg.norm(arm, axis=1), np.flatnonzero(np.diff(local, prepend=-1)))[local, None]
    # (m, 3, 6): displacement of each node under its cluster's unit translations and rotations.
    turn = np.cross(np.eye(3)[None], arm[:, None]).swapaxes(1, 2)
    motion = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=2)
    column = np.broadcast_to(6 * local[:, None, None] + np.arange(6), motion.shape)
    row = np.broadcast_to(np.arange(3 * len(node)).reshape(-1, 3, 1), motion.shape)
    moves = sp.csr_array((motion.ravel(), (row.ravel(), column.ravel())), shape=(3 * len(node), 6 * len(names)))
    along = normal[node].ravel(), np.arange(3 * len(node)), np.arange(0, 3 * len(node) + 1, 3)
    across = sp.csr_array(along, shape=(len(node), 3 * len(node))) @ moves
    order, x = np.argsort(node, kind="stable"), np.arange(3)
    joint = np.flatnonzero(node[order[1:]] == node[order[:-1]])
    one, other = ((3 * order[joint + k][:, None] + x).ravel() for k in (0, 1))
    resisted = sp.vstack([moves[fixed[node].ravel()], across, moves[one] - moves[other]])
    equations = int(fixed[node].sum() + (normal[node] != 0.0).any(axis=1).sum() + len(one))
    values, vectors = np.linalg.eigh((resisted.T @ resisted).toarray())
    amount = np.abs(vectors[:, 0]).reshape(-1, 6).max(axis=1)
    return int((values <= tolerance**2 * max(equations, 1)).sum()), int(names[np.argmax(amount)])

"""Whether the constraints hold a body: no part of it may move rigidly without resistance."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from .errors import InputError
from .mesh import TetMesh


def check_held(mesh: TetMesh, held: np.ndarray, normal: np.ndarray) -> None:
    """Refuse a body, or a loose piece of one, that can translate or rotate freely.

    held (V, 3) bool and normal (V, 3) are the constraints. A node of no element must be held: nothing else stops it.

    Raises
    ------
    InputError
        Naming the piece and what is missing.
    """
    count = len(mesh.nodes)
    used = np.zeros(count, bool)
    used[mesh.tets] = True
    loose = np.flatnonzero(~used & ~held.all(axis=1))
    if len(loose):
        raise InputError(f"node {loose[0]} (and {len(loose) - 1} more) belongs to no tetrahedron: remove or hold it.")
    links = sp.coo_array(
        (np.ones(3 * len(mesh.tets)), (np.repeat(mesh.tets[:, 0], 3), mesh.tets[:, 1:].ravel())), shape=(count, count)
    )
    _, piece = sp.csgraph.connected_components(links, directed=False)
    for number in np.unique(piece[used]):
        nodes = np.flatnonzero(piece == number)
        free = 6 - _rank_of_rigid_motions(mesh.nodes[nodes], held[nodes], normal[nodes])
        if free:
            where = np.round(1e3 * mesh.nodes[nodes].mean(axis=0), 1)
            what = "the body" if len(nodes) == used.sum() else f"a loose piece of {len(nodes)} nodes round {where} mm"
            raise InputError(
                f"{what} can move rigidly in {free} of 6 ways: hold at least three nodes of it that are not in line."
            )


def _rank_of_rigid_motions(nodes: np.ndarray, held: np.ndarray, normal: np.ndarray) -> int:
    """How many of the six rigid motions the constraints on `nodes` (n, 3) feel."""
    arm = nodes - nodes.mean(axis=0)
    arm = arm / max(np.linalg.norm(arm, axis=1).max(), 1e-300)
    turn = np.cross(np.eye(3)[None], arm[:, None])  # (n, 3, 3): displacement of each node under each unit rotation
    motion = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=1)  # (n, 6, 3)
    felt = np.concatenate(
        [np.swapaxes(motion, 1, 2)[held], np.einsum("nmi,ni->nm", motion, normal)[(normal != 0.0).any(axis=1)]]
    )
    return 0 if len(felt) == 0 else int(np.linalg.matrix_rank(felt, tol=1e-6 * np.sqrt(len(felt))))

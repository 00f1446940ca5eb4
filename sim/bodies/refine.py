"""The same body on a mesh twice as fine: what a mesh's own error is measured against."""

from __future__ import annotations

import numpy as np

from ..anatomy import Anatomy
from ..discretisation.space import discretise
from ..errors import InputError
from ..geometry.tetmesh import TetMesh, oriented

# Nodes of a quadratic tetrahedron: four children keep a corner each; the octahedron between them is cut along one of
# its three diagonals, round which its other four nodes stand in this order.
CORNERS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]])
DIAGONALS = np.array([[4, 9], [5, 7], [6, 8]])
ROUND = np.array([[6, 7, 8, 5], [4, 6, 9, 8], [4, 5, 9, 7]])


def refined(anatomy: Anatomy) -> Anatomy:
    """Every tetrahedron in eight, every edge halved; held and sliding nodes as quadratic elements would have them.

    The octahedron inside is cut along its shortest diagonal: Bey 1995, "Tetrahedral grid refinement", Computing
    55:355-378, cuts it along a fixed one.

    Raises
    ------
    InputError
        A mesh with mid-edge nodes of its own.
    """
    mesh = anatomy.mesh
    if mesh.middles is not None:
        raise InputError("a quadratic mesh is not refined: give the linear one.")
    space = discretise(mesh, "p2")
    nodes, table = space.nodes, space.table
    ends = nodes[table[:, DIAGONALS]]
    shortest = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2).argmin(axis=1)
    around = ROUND[shortest]
    inner = [np.column_stack([DIAGONALS[shortest], around[:, k], around[:, (k + 1) % 4]]) for k in range(4)]
    cut = np.stack([np.take_along_axis(table, one, axis=1) for one in inner], axis=1)
    children = np.concatenate([table[:, CORNERS], cut], axis=1)
    tets, _ = oriented(nodes, children.reshape(-1, 4))
    held, normal = space.held(anatomy.held), space.sliding(anatomy.slide_normal, anatomy.held)
    craniotomy = np.zeros(space.count, bool)
    opening = space.surface[anatomy.craniotomy[mesh.surface].all(axis=1)]
    craniotomy[opening] = True
    craniotomy[: len(mesh.nodes)] = anatomy.craniotomy
    free = ~held.any(axis=1) & (normal == 0.0).all(axis=1)
    return Anatomy(TetMesh(nodes, tets, np.repeat(mesh.region, 8)), held, normal, craniotomy & free)

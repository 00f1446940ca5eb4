"""Condensing a body to what a tool may touch of it: how that gives, and how tumour and cortex follow, at rest."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from sim.fem import Fem
from sim.tools import Ball, BuiltIn, core_of

from ..data.encode import Basis, reduce
from ..regressors.rigid_contact import Contact

# Nodes whose unit responses are asked for together: bounds the memory that they take.
STRIP = 64
# Share of the unit responses that a basis may lose.
TOLERANCE = 1e-4


def condensed(fem: Fem, parts: list[np.ndarray], tool: BuiltIn | None = None) -> tuple[Contact, list[Basis]]:
    """Contact of a tool with a body at rest, answered for `parts` of its vertices, and a basis of each of them.

    Without a `tool` it is a ball of the radius that features have. The answers are coefficients of the bases, one after
    the other.
    """
    surface = fem.anatomy.mesh.surface[fem.anatomy.bare]
    nodes, triangles = np.unique(surface, return_inverse=True)
    response = unit_responses(fem, nodes, np.concatenate([nodes, *parts]))
    compliance, *answers = np.split(response, np.cumsum([len(nodes), *map(len, parts[:-1])]), axis=1)
    bases = [reduce(some, each, TOLERANCE, len(each)) for some, each in zip(parts, answers, strict=True)]
    coefficients = np.hstack([basis.encode(each) for basis, each in zip(bases, answers, strict=True)])
    rows = 3 * len(nodes)
    contact = Contact(
        fem.anatomy.mesh.nodes[nodes],
        triangles,
        compliance.reshape(rows, rows),
        coefficients,
        np.repeat([[1.0], [0.0]], coefficients.shape[1], axis=1),
        core=np.zeros(0) if tool is None or isinstance(tool, Ball) else _sizes(tool),
    )
    return contact, bases


def _sizes(tool: BuiltIn) -> np.ndarray:
    """Half sizes of what a tool lies round, and its radius (4,) [m]."""
    core = core_of(tool)
    return np.append(core.half, core.radius)


def side_by_side(bases: list[Basis]) -> Basis:
    """One basis of the vertices of all of them."""
    modes = np.asarray(block_diag(*(basis.modes for basis in bases)))
    return Basis(np.concatenate([basis.nodes for basis in bases]), modes)


def unit_responses(fem: Fem, nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Motions (3 n, k, 3) float32 [m/N] of the vertices `at` (k,) of unit forces on `nodes` (n,) at rest."""
    found = []
    for first in range(0, len(nodes), STRIP):
        some = nodes[first : first + STRIP]
        answers = fem.reading(some, np.eye(3 * len(some)).reshape(-1, len(some), 3)).answers
        found.append(answers.reshape(len(answers), -1, 3)[:, at].astype(np.float32))
    return np.concatenate(found)

"""Static condensation: how stiff the rest of a body is, at rest, for a part of it, and how it follows.

Guyan 1965, "Reduction of stiffness and mass matrices", AIAA J. 3:380.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from .device import Device
from .factor import node_of
from .precondition import direct
from .problem import Problem

# Entries beside this share of the largest are what subtraction leaves of zero.
ROUND_OFF = 1e-9
# Columns that are solved for together: bounds the memory that it takes.
STRIP = 256


@dataclass(frozen=True, eq=False)
class Condensation:
    """What a part of a body feels of the rest.

    rows (m,) of the part's 3n that touch the rest; stiffness (m, m) [N/m] of the rest there; follow (3N, m): how the
    whole body's rows move when these do, zero in the part itself.
    """

    rows: np.ndarray
    stiffness: np.ndarray
    follow: np.ndarray


def condensed(problem: Problem, nodes: np.ndarray, own: sp.csc_array) -> Condensation:
    """The rest of a body beside the part of `nodes` (n,), whose own elements have the stiffness `own` (3n, 3n) at rest.

    Raises
    ------
    RuntimeError
        The rest is not held even where the part is.
    """
    part = (3 * nodes[:, None] + np.arange(3)).ravel()
    whole, basis = sp.csr_array(problem.rest_curvature()), problem.constraint.basis()
    beyond = sp.csr_array(whole[part][:, part] - own)
    rows = np.flatnonzero(abs(beyond).max(axis=1).toarray().ravel() > ROUND_OFF * abs(whole).max())
    stiffness = beyond[rows][:, rows].toarray()
    far = sp.csc_array(basis[:, ~np.isin(node_of(basis), nodes)])
    fine = Device(problem.device.name, "float64")
    solver = direct(sp.csc_array(whole), far, node_of(far), fine, "float64")
    coupling = sp.csc_array(whole[part[rows]].T)
    follow = np.zeros((problem.rows, len(rows)), problem.device.precision)
    for first in range(0, len(rows), STRIP):
        some = coupling[:, first : first + STRIP].toarray()
        out = fine.zeros(*some.shape)
        solver.apply(fine.array(some), np.ones(some.shape[1], bool), out)
        moved = out.numpy()
        follow[:, first : first + STRIP] = -moved
        stiffness[:, first : first + STRIP] -= coupling.T @ moved
    return Condensation(rows, (stiffness + stiffness.T) / 2, follow)

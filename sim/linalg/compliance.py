"""How a body at rest gives way to forces on some of its nodes: columns of its preconditioner, made when needed."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..discretisation.problem import Problem
from .pcg import Preconditioner

# Nodes whose columns are made together, always by the same arithmetic: what is kept decides on time, never on numbers.
BLOCK = 16
# Bytes of columns that are kept at most, or a few blocks.
MOST_BYTES, FEWEST_BLOCKS = 2**28, 8


class Compliance:
    """H (3N, 3N) [m/N], as a preconditioner does it, and its columns at some nodes.

    Parameters
    ----------
    problem
        Whose free motions count.
    preconditioner
        Of the problem, alike at every state.
    nodes
        (n,) node numbers.
    """

    def __init__(self, problem: Problem, preconditioner: Preconditioner, nodes: np.ndarray):
        self._problem, self._preconditioner, self._nodes = problem, preconditioner, nodes
        self.rows = (3 * nodes[:, None] + np.arange(3)).ravel()
        size = 3 * BLOCK * problem.rows * np.dtype(problem.device.precision).itemsize
        self._block = lru_cache(max(FEWEST_BLOCKS, MOST_BYTES // size))(self._columns)

    def answered(self, force: np.ndarray) -> np.ndarray:
        """H force: motions (3N, b) [m] under forces (3N, b) [N]."""
        device, constraint = self._problem.device, self._problem.constraint
        pull, out = device.array(force), device.zeros(*force.shape)
        constraint.project_nodes(pull)
        self._preconditioner.apply(pull, np.ones(force.shape[1], bool), out)
        constraint.project_nodes(out)
        return out.numpy()

    def spread(self, force: np.ndarray) -> np.ndarray:
        """Motion (3N,) [m] of all nodes under a force (3n,) [N] on these n."""
        out = np.zeros(self._problem.rows, self._problem.device.precision)
        for node, own in _acting(force):
            out += own.astype(out.dtype) @ self._block(node // BLOCK)[0][node % BLOCK]
        return out

    def moved(self, force: np.ndarray) -> np.ndarray:
        """Motion (3n,) [m] of these n nodes alone."""
        out = np.zeros(len(force))
        for node, own in _acting(force):
            out += own @ self._block(node // BLOCK)[1][node % BLOCK]
        return out

    def between(self, some: np.ndarray) -> np.ndarray:
        """H (3a, 3a) [m/N] between `some` (a,) of the n nodes."""
        rows = (3 * some[:, None] + np.arange(3)).ravel()
        return np.concatenate([self._block(node // BLOCK)[1][node % BLOCK][:, rows] for node in some.tolist()])

    def _columns(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Of a block's nodes, (BLOCK, 3, 3N), and at the n nodes in double precision (BLOCK, 3, 3n)."""
        rows = self.rows[3 * BLOCK * number : 3 * BLOCK * (number + 1)]
        unit = np.zeros((self._problem.rows, 3 * BLOCK))
        unit[rows, np.arange(len(rows))] = 1.0
        whole = np.ascontiguousarray(self.answered(unit).T).reshape(BLOCK, 3, -1)
        return whole, whole[:, :, self.rows].astype(np.float64)


def _acting(force: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The numbers of the nodes at which a force (3n,) acts, and what (3,) acts there."""
    own = force.reshape(-1, 3)
    return [(node, own[node]) for node in np.flatnonzero(own.any(axis=1)).tolist()]

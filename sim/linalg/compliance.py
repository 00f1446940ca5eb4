"""How a body at rest gives way to forces on some of its nodes: columns of its preconditioner, made when needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..discretisation.problem import Problem
from .pcg import Preconditioner


@dataclass(frozen=True)
class Columns:
    """Which columns of a compliance are made together, and how many are kept.

    Parameters
    ----------
    block
        Nodes whose columns are made together, always by the same arithmetic: what is kept decides on time, never on
        numbers.
    most_bytes, fewest_blocks
        Bytes of columns that are kept at most, or so many blocks where these take more.
    """

    block: int = 16
    most_bytes: int = 2**28
    fewest_blocks: int = 8


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
    columns
        How they are made and kept.
    """

    def __init__(
        self, problem: Problem, preconditioner: Preconditioner, nodes: np.ndarray, columns: Columns = Columns()
    ):
        self._problem, self._preconditioner, self._nodes = problem, preconditioner, nodes
        self.rows = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._size = columns.block
        size = 3 * self._size * problem.rows * np.dtype(problem.device.precision).itemsize
        self._block = lru_cache(max(columns.fewest_blocks, columns.most_bytes // size))(self._columns)

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
            out += own.astype(out.dtype) @ self._block(node // self._size)[0][node % self._size]
        return out

    def moved(self, force: np.ndarray) -> np.ndarray:
        """Motion (3n,) [m] of these n nodes alone."""
        out = np.zeros(len(force))
        for node, own in _acting(force):
            out += own @ self._block(node // self._size)[1][node % self._size]
        return out

    def between(self, some: np.ndarray) -> np.ndarray:
        """H (3a, 3a) [m/N] between `some` (a,) of the n nodes."""
        rows = (3 * some[:, None] + np.arange(3)).ravel()
        places = (divmod(node, self._size) for node in some.tolist())
        return np.concatenate([self._block(block)[1][place][:, rows] for block, place in places])

    def _columns(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Of a block's k nodes, (k, 3, 3N), and at the n nodes in double precision (k, 3, 3n)."""
        rows = self.rows[3 * self._size * number : 3 * self._size * (number + 1)]
        unit = np.zeros((self._problem.rows, 3 * self._size))
        unit[rows, np.arange(len(rows))] = 1.0
        whole = np.ascontiguousarray(self.answered(unit).T).reshape(self._size, 3, -1)
        return whole, whole[:, :, self.rows].astype(np.float64)


def _acting(force: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The numbers of the nodes at which a force (3n,) acts, and what (3,) acts there."""
    own = force.reshape(-1, 3)
    return [(node, own[node]) for node in np.flatnonzero(own.any(axis=1)).tolist()]

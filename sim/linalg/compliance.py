"""Compliance of the undeformed mesh at selected nodes: columns of the preconditioner, computed when needed."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ..discretisation.problem import Problem
from ..runtime.views import cast_like, to_double, to_host, to_library, to_view
from .multifrontal import SparseFactor
from .pcg import Preconditioner


@dataclass(frozen=True)
class ColumnCache:
    """Block size and cache size of the columns of a compliance.

    Parameters
    ----------
    block_size
        Number of nodes whose columns are computed together. The cache affects only the time, not the values.
    max_bytes, min_blocks
        Maximum size of the cached columns [bytes], and minimum number of cached blocks even if their size is larger.
    """

    block_size: int = 16
    max_bytes: int = 2**28
    min_blocks: int = 8


class Compliance:
    """Compliance H (3N, 3N) [m/N], applied by a preconditioner; the columns of n nodes are stored on the device.

    Parameters
    ----------
    problem
        Problem whose free motions are used.
    preconditioner
        Preconditioner of the problem that does not depend on the state.
    nodes
        Node numbers (n,).
    columns
        Block size and cache size of the columns.

    `rows` (3n,) are the rows of the nodes; `places` is a copy of `rows` on the device.
    """

    def __init__(
        self, problem: Problem, preconditioner: Preconditioner, nodes: np.ndarray, columns: ColumnCache = ColumnCache()
    ):
        device = problem.device
        self._problem, self._preconditioner, self.nodes = problem, preconditioner, nodes
        self.rows = (3 * nodes[:, None] + np.arange(3)).ravel()
        self.places = to_library(device, self.rows)
        self._width = 3 * columns.block_size
        self.columns = to_view(replace(device, precision="float64").allocate(len(self.rows), len(self.rows)))
        self.known = np.zeros(len(nodes), bool)
        size = self._width * problem.rows * np.dtype(device.precision).itemsize
        self._kept = max(columns.min_blocks, columns.max_bytes // size)
        self._block = lru_cache(self._kept)(self._compute_columns)

    def apply(self, force: Any) -> Any:
        """Return the displacements H `force` (3N, b) [m] under forces (3N, b) [N]."""
        device, constraint = self._problem.device, self._problem.constraint
        pull, out = device.allocate(*force.shape), device.allocate(*force.shape)
        to_view(pull)[:] = force
        constraint.project_nodes(pull)
        self._preconditioner.apply(pull, np.ones(force.shape[1], bool), out)
        constraint.project_nodes(out)
        return to_view(out)

    def compute_full_motion(self, force: Any) -> Any:
        """Return the displacements (3N, b) [m] of all nodes under forces (3n, b) [N] on the first n of `nodes`."""
        device, every = self._problem.device, -(-len(force) // self._width)
        out = to_view(device.allocate(self._problem.rows, force.shape[1]))
        if isinstance(self._preconditioner, SparseFactor):  # its two sweeps are faster than its columns
            out[self.rows[: len(force)]] = force
            return self.apply(out)
        force = cast_like(out, force)
        # On a GPU, multiplying by zeros is faster than asking where they are.
        at_hand = device.on_cuda and self.known[: len(force) // 3].all() and every <= self._kept
        for block in range(every) if at_hand else self._find_blocks(to_host((force != 0.0).any(1))):
            some = force[self._get_rows(block)]
            out += self._block(block)[:, : len(some)] @ some
        return out

    def compute_motion(self, force: Any) -> Any:
        """Return displacements (3n, b) [m] of `nodes` under forces (3m, b) [N] on the first m, with known columns."""
        if self._problem.device.on_cuda:
            return self.columns[: len(force)].T @ to_double(force)
        acting = np.flatnonzero(to_host((force != 0.0).any(1)))
        return self.columns[acting].T @ to_double(force[acting])

    def build_matrix(self, node_mask: np.ndarray) -> Any:
        """Return H (3n, 3n) [m/N] between `nodes`; only the columns of nodes marked in `node_mask` (n,) are valid."""
        self.ensure_columns(node_mask)
        return self.columns.T

    def ensure_columns(self, node_mask: np.ndarray) -> None:
        """Compute missing columns of nodes in `node_mask` (n,), stored as rows, and mark them in `known` (n,)."""
        missing = node_mask & ~self.known
        if missing.any() and isinstance(self._preconditioner, SparseFactor):
            self.columns[:], self.known[:] = self._preconditioner.compute_compliance(self.rows).T, True
        for block in self._find_blocks(np.repeat(node_mask & ~self.known, 3)):
            self._block(block)

    def _find_blocks(self, rows: np.ndarray) -> list[int]:
        """Return the numbers of the blocks that contain a marked row; `rows` (3n,) is a mask."""
        return np.unique(np.flatnonzero(rows) // self._width).tolist()

    def _get_rows(self, block: int) -> slice:
        return slice(self._width * block, self._width * (block + 1))

    def _compute_columns(self, block: int) -> Any:
        """Return the columns (3N, k) [m/N] of a block, and store the rows at the nodes in double precision."""
        own = self._get_rows(block)
        unit = np.zeros((self._problem.rows, self._width))
        unit[self.rows[own], np.arange(len(self.rows[own]))] = 1.0
        whole = self.apply(to_library(self._problem.device, unit))[:, : len(self.rows[own])]
        if not self.known[own.start // 3 : own.stop // 3].all():
            self.columns[own], self.known[own.start // 3 : own.stop // 3] = whole[self.places].T, True
        return whole

"""The rest stiffness, factorised once and applied to many right-hand sides: multifrontal elimination in dense blocks.

Each front keeps one dense panel, so that both sweeps of a solve are a product a front: memory's speed for one
right-hand side, the arithmetic's for many. SuperLU, with its small supernodes, takes three times as long for one and
twenty times for 64.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import get_lapack_funcs
from threadpoolctl import ThreadpoolController

from .accuracy import Precision
from .device import Device
from .fronts import Front, fronts_of
from .problem import Problem
from .sweep import Sweep

potrf, potri = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)

# Up to so many right-hand sides, sweeps one by one are faster than products of matrices.
FEW = 3
# A pivot that has lost so many digits is zero: the last ones are round-off.
SINGULAR = 1e-13


class Factor:
    """A stiffness K over some motions, L (L^T K L)^-1 L^T, factorised once on the host in double precision.

    Parameters
    ----------
    stiffness
        K (3N, 3N) [N/m].
    motions
        L (3N, n): independent motions as columns. Their own unknowns, three to a node, are numbered by `node` (n,).
    device
        Where the right-hand sides live; the factor is kept in its precision.

    Raises
    ------
    RuntimeError
        K is singular over these motions: something is not held.
    """

    on_device = False

    def __init__(self, stiffness: sp.csc_array, motions: sp.csc_array, node: np.ndarray, device: Device):
        free = sp.csc_array(motions.T @ stiffness @ motions)
        order, fronts = fronts_of(free, node)
        motions = sp.csc_array(motions[:, order].astype(device.precision))
        self._motions, self._transposed = sp.csr_array(motions), sp.csr_array(motions.T)
        self._blas = ThreadpoolController()
        self._fronts = fronts
        with self._blas.limit(limits=1, user_api="blas"):
            whole, self._panels = panels_of(sp.csc_array(free[order][:, order]), fronts, device.precision)
        self._sweep = Sweep(fronts, whole, device.precision)

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """One sweep up and one down for the live columns: the others would cost as much."""
        values = r.numpy()
        solved = np.zeros_like(values)
        solved[:, live] = self._motions @ self._solved(self._transposed @ values[:, live])
        out.assign(solved)

    def _solved(self, x: np.ndarray) -> np.ndarray:
        if x.shape[1] <= FEW:
            return self._sweep.solved(x)
        # Threads of BLAS wait for one another at every front, ages where something else runs on their cores.
        with self._blas.limit(limits=1, user_api="blas"):
            for front, panel in zip(self._fronts, self._panels, strict=True):
                size = front.stop - front.first
                product = panel.T @ x[front.first : front.stop]
                x[front.first : front.stop] = product[:size]
                x[front.border] -= product[size:]
            for front, panel in zip(reversed(self._fronts), reversed(self._panels), strict=True):
                size = front.stop - front.first
                x[front.first : front.stop] -= panel[:, size:] @ x[front.border]
        return x


def node_of(basis: sp.csc_array) -> np.ndarray:
    """The node (n,) that each column of a constraint's basis (3N, n) moves."""
    return np.asarray(basis.indices[basis.indptr[:-1]] // 3)


def panels_of(matrix: sp.csc_array, fronts: list[Front], precision: Precision) -> tuple[np.ndarray, list[np.ndarray]]:
    """All panels in one array, and its parts: of a front of k own and m border unknowns (k, k + m) [S^-1, S^-1 C^T].

    S (k, k) and C (m, k) are the rows of the matrix at the front's own and border unknowns, what was eliminated before
    them subtracted. Solving is then, upwards, x_border -= (S^-1 C^T)^T x_own and x_own = S^-1 x_own, and downwards
    x_own -= S^-1 C^T x_border.

    Raises
    ------
    RuntimeError
        The matrix is not positive definite.
    """
    matrix.sort_indices()
    diagonal = matrix.diagonal()
    owner = np.repeat(np.arange(len(fronts)), [front.stop - front.first for front in fronts])
    waiting: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    shapes = [(front.stop - front.first, len(front.rows)) for front in fronts]
    ends = np.cumsum([0, *(k * n for k, n in shapes)])
    together = np.zeros(ends[-1], precision)
    panels = [part.reshape(shape) for part, shape in zip(np.split(together, ends[1:-1]), shapes, strict=False)]
    for number, (front, panel) in enumerate(zip(fronts, panels, strict=True)):
        rows, size = front.rows, front.stop - front.first
        whole = np.zeros((len(rows), len(rows)))
        entries = slice(matrix.indptr[front.first], matrix.indptr[front.stop])
        row, value = matrix.indices[entries], matrix.data[entries]
        column = np.repeat(np.arange(size), np.diff(matrix.indptr[front.first : front.stop + 1]))
        later = row >= front.first
        whole[np.searchsorted(rows, row[later]), column[later]] = value[later]
        for border, update in waiting.pop(number, ()):
            place = np.searchsorted(rows, border)
            whole[np.ix_(place, place)] += update
        inverse = _inverse(whole[:size, :size], diagonal[front.first : front.stop])
        coupling = whole[size:, :size]
        across = coupling @ inverse
        if len(front.border):
            above = int(owner[front.border[0]])
            waiting.setdefault(above, []).append((front.border, whole[size:, size:] - across @ coupling.T))
        panel[:, :size], panel[:, size:] = inverse, across.T
    return together, panels


def _inverse(block: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """Of a positive definite block (k, k), of which only the lower half is read; diagonal (k,) of the whole matrix."""
    lower, info = potrf(block, lower=1)
    if info or (np.diagonal(lower) ** 2 <= SINGULAR * diagonal).any():
        raise RuntimeError("it is not positive definite")
    inverse, _ = potri(lower, lower=1)
    half = np.tril(inverse, -1)
    return half + half.T + np.diag(np.diagonal(inverse))

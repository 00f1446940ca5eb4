"""Undeformed stiffness, factorised once for many right-hand sides by multifrontal elimination in dense blocks.

Each front stores one dense panel, so that a sweep of a solve has one product per front. Memory bandwidth limits the
sweep for one right-hand side, arithmetic for many. SuperLU, with its small supernodes, takes three times as long for
one right-hand side, and twenty times as long for 64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from ..accuracy import Precision
from ..discretisation.problem import Problem
from ..runtime.device import Device
from ..runtime.threads import choose_threads, limit_to_one_thread, run_concurrently
from .symbolic import FRONT_SIZES, Front, FrontSizes, build_fronts
from .triangular_solve import TriangularSweeps, add_lower_block

# Cholesky factor, inverse of a triangular matrix, symmetric update, and triangular solve.
potrf, trtri = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)
syrk, trsm = get_blas_funcs(("syrk", "trsm"), dtype=np.float64)

# For each later front: border unknowns (m,), and the lower half of the update matrix (m, m) at them.
Updates = dict[int, list[tuple[np.ndarray, np.ndarray]]]


@dataclass(frozen=True)
class FactorSettings:
    """Settings of a factor and of its triangular sweeps.

    Parameters
    ----------
    max_separate_sweeps
        Maximum number of right-hand sides for which separate sweeps are faster than matrix products.
    strip_size
        Number of right-hand sides of one sweep, so that the sweep stays in the cache of a CPU core.
    pivot_tolerance
        A pivot below this fraction of its diagonal entry counts as zero, since its remaining digits are round-off.
    fronts
        Sizes of the fronts.
    """

    max_separate_sweeps: int = 3
    strip_size: int = 128
    pivot_tolerance: float = 1e-13
    fronts: FrontSizes = FRONT_SIZES


class SparseFactor:
    """Inverse L (L^T K L)^-1 L^T of a stiffness K over motions L, factorised once on the host in double precision.

    Parameters
    ----------
    stiffness
        K (3N, 3N) [N/m].
    motions
        L (3N, n), with independent motions as columns. `node` (n,) gives the node to which each motion belongs.
    device
        Device of the right-hand sides.
    precision
        Precision of the stored factor. The inverse is symmetric and positive definite in both precisions. Single
        precision halves the memory traffic.
    settings
        Settings of the factor and of its triangular sweeps.

    Raises
    ------
    RuntimeError
        K is singular over these motions, since a part of the mesh is not fixed.
    """

    on_device = False

    def __init__(
        self,
        stiffness: sp.csc_array,
        motions: sp.csc_array,
        node: np.ndarray,
        device: Device,
        precision: Precision = "float32",
        settings: FactorSettings = FactorSettings(),
    ):
        free = sp.csc_array(motions.T @ stiffness @ motions)
        order, fronts = build_fronts(free, node, choose_threads(len(node)), settings.fronts)
        motions = sp.csc_array(motions[:, order].astype(device.precision))
        self._motions, self._transposed = sp.csr_array(motions), sp.csr_array(motions.T)
        self._precision, self._settings = precision, settings
        with limit_to_one_thread():
            values, self._panels = factorise_panels(
                sp.csc_array(free[order][:, order]), fronts, precision, settings.pivot_tolerance
            )
        self._sweep = TriangularSweeps(fronts, values, precision)

    def prepare(self, problem: Problem, columns: int) -> None:
        """Do nothing, since the undeformed stiffness does not depend on the state."""

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Solve for the live load cases only, by one forward and one backward sweep; other cases would cost as much."""
        values = r.numpy()
        solved = np.zeros_like(values)
        x = self._transposed @ values[:, case_mask]
        # Scaled, because single precision cannot represent forces of 1e-40 N in a product with load cases of 1 N.
        size = np.abs(x).max(axis=0, initial=0.0)
        size[size == 0.0] = 1.0
        solved[:, case_mask] = self._motions @ (self._solve_columns((x / size).astype(self._precision)) * size)
        out.assign(solved)

    def compute_compliance(self, rows: np.ndarray) -> np.ndarray:
        """Return the compliance (m, m) [m/N] at the given `rows` (m,) of the 3N rows, in the precision of the factor.

        The sweeps include only the fronts of these rows and the fronts that depend on them.
        """
        chosen = self._motions[rows]
        unit = sp.csc_array(chosen.T)
        reached = np.zeros(len(self._transposed.indptr) - 1, bool)
        reached[chosen.indices] = True
        panels = []
        for panel in self._panels:
            if reached[panel.front.first : panel.front.stop].any():
                reached[panel.front.border] = True
                panels.append(panel)
        out, size = np.empty((len(rows), len(rows)), self._precision), self._settings.strip_size

        def fill_strips(first_columns: range) -> None:
            for first in first_columns:
                strip = slice(first, first + size)
                x = unit[:, strip].toarray(order="C").astype(self._precision)
                out[:, strip] = chosen @ _apply_sweeps(panels, x)

        share = choose_threads(len(rows))
        with limit_to_one_thread():
            run_concurrently([partial(fill_strips, range(size * k, len(rows), size * share)) for k in range(share)])
        return out

    def _solve_columns(self, x: np.ndarray) -> np.ndarray:
        if x.shape[1] <= self._settings.max_separate_sweeps:
            return self._sweep.solve(x)
        # BLAS threads wait for one another at every front, very long where other processes use their cores.
        with limit_to_one_thread():
            return _apply_sweeps(self._panels, x)


def find_moved_nodes(basis: sp.csc_array) -> np.ndarray:
    """Return the node (n,) that is moved by each column of a constraint basis (3N, n)."""
    return np.asarray(basis.indices[basis.indptr[:-1]] // 3)


@dataclass(frozen=True, eq=False)
class FrontPanel:
    """Stored part of a front with k own and m border unknowns: `values` (k, k + m) = R^-T [1, -R^-1 C^T].

    S = R R^T (k, k) and C (m, k) are the rows of the matrix at the front's own and border unknowns, after the earlier
    eliminations. `down` is the exact transpose of `up` despite rounding: the product stays symmetric and positive
    definite.
    """

    front: Front
    values: np.ndarray

    def substitute_forward(self, x: np.ndarray) -> None:
        """Eliminate: x_own = R^-1 x_own, x_border -= C S^-1 x_own, in x (n, b)."""
        own = slice(self.front.first, self.front.stop)
        product = self.values.T @ x[own]
        x[own] = product[: len(self.values)]
        x[self.front.border] += product[len(self.values) :]

    def substitute_backward(self, x: np.ndarray) -> None:
        """Substitute back: x_own = R^-T x_own - S^-1 C^T x_border, in x (n, b)."""
        x[self.front.first : self.front.stop] = self.values @ x[self.front.rows]


def _apply_sweeps(panels: Sequence[FrontPanel], x: np.ndarray) -> np.ndarray:
    """Apply the forward and the backward sweep through the panels to x (n, b), in place."""
    for panel in panels:
        panel.substitute_forward(x)
    for panel in reversed(panels):
        panel.substitute_backward(x)
    return x


def factorise_panels(
    matrix: sp.csc_array, fronts: Sequence[Sequence[Front]], precision: Precision, pivot_tolerance: float
) -> tuple[np.ndarray, list[FrontPanel]]:
    """Factorise a matrix, and return one array with the values of all panels, and the panels.

    Raises
    ------
    RuntimeError
        The matrix is not positive definite.
    """
    matrix.sort_indices()
    every = [front for part in fronts for front in part]
    shapes = [(front.stop - front.first, len(front.rows)) for front in every]
    cuts = np.cumsum([0, *(k * n for k, n in shapes)])
    values = np.zeros(cuts[-1], precision)
    panels = [
        FrontPanel(front, values[first:stop].reshape(shape))
        for front, shape, (first, stop) in zip(every, shapes, pairwise(cuts), strict=True)
    ]
    ends = np.cumsum([0, *(len(part) for part in fronts)]).tolist()
    work = _Fronts(matrix, panels, pivot_tolerance)
    lower = [partial(work.eliminate, range(first, stop)) for first, stop in pairwise(ends[:-1])]
    left: list[Updates] = [{} for _ in lower]
    run_concurrently([partial(task, updates) for task, updates in zip(lower, left, strict=True)])
    meeting: Updates = {}
    for updates in left:
        for number, waiting in updates.items():
            meeting.setdefault(number, []).extend(waiting)
    work.eliminate(range(ends[-2], ends[-1]), meeting)
    return values, panels


class _Fronts:
    """Elimination of the fronts of a sparse matrix; fronts in different parts may be eliminated at the same time."""

    def __init__(self, matrix: sp.csc_array, panels: Sequence[FrontPanel], pivot_tolerance: float):
        self._matrix, self._panels = matrix, panels
        self._least = pivot_tolerance * matrix.diagonal()
        sizes = [len(panel.values) for panel in panels]
        self._owner = np.repeat(np.arange(len(panels)), sizes)

    def eliminate(self, front_numbers: range, updates: Updates) -> None:
        """Fill the panels of fronts `front_numbers`, with their pending `updates`; add updates of later fronts."""
        for number in front_numbers:
            panel = self._panels[number]
            front, size = panel.front, len(panel.values)
            whole = self._assemble_rows(front)
            for border, update in updates.pop(number, ()):
                add_lower_block(update, np.searchsorted(front.rows, border), whole)
            root, info = potrf(whole[:size, :size], lower=1)
            if info or (np.diagonal(root) ** 2 <= self._least[front.first : front.stop]).any():
                raise RuntimeError("it is not positive definite")
            panel.values[:, :size] = trtri(root, lower=1)[0].T
            if len(front.border):
                across = trsm(1.0, root, whole[size:, :size], side=1, lower=1, trans_a=1)
                update = syrk(-1.0, across, beta=1.0, c=whole[size:, size:], lower=1)
                updates.setdefault(int(self._owner[front.border[0]]), []).append((front.border, update))
                panel.values[:, size:] = -trsm(1.0, root, across, side=1, lower=1).T

    def _assemble_rows(self, front: Front) -> np.ndarray:
        """Return the lower half of a front's matrix (k + m, k + m), assembled from the columns of its own unknowns."""
        start, rows, size = self._matrix.indptr, front.rows, front.stop - front.first
        whole = np.zeros((len(rows), len(rows)), order="F")
        entries = slice(start[front.first], start[front.stop])
        row, value = self._matrix.indices[entries], self._matrix.data[entries]
        column = np.repeat(np.arange(size), np.diff(start[front.first : front.stop + 1]))
        later = row >= front.first + column
        whole[np.searchsorted(rows, row[later]), column[later]] = value[later]
        return whole

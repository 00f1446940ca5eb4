"""The rest stiffness, factorised once and applied to many right-hand sides: multifrontal elimination in dense blocks.

Each front keeps one dense panel, so that both sweeps of a solve are a product a front: memory's speed for one
right-hand side, the arithmetic's for many. SuperLU, with its small supernodes, takes three times as long for one and
twenty times for 64.
"""

from __future__ import annotations

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
from ..runtime.threads import choose_threads, limit_to_one_thread, run_together
from .symbolic import FRONT_SIZES, Front, FrontSizes, build_fronts
from .triangular_solve import Sweep, add_lower

potrf, trtri = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)
syrk, trsm = get_blas_funcs(("syrk", "trsm"), dtype=np.float64)

# Border unknowns and their lower half of a matrix (m, m), for each front that these wait for.
Updates = dict[int, list[tuple[np.ndarray, np.ndarray]]]


@dataclass(frozen=True)
class Factorisation:
    """How a factor is made and swept.

    Parameters
    ----------
    few
        Right-hand sides up to which sweeps one by one are faster than products of matrices.
    strip
        Right-hand sides that stay in a core's cache while they are swept.
    singular
        A pivot that has shrunk to this share of its diagonal is zero: the last digits are round-off.
    fronts
        What is eliminated together.
    """

    few: int = 3
    strip: int = 128
    singular: float = 1e-13
    fronts: FrontSizes = FRONT_SIZES


class Factor:
    """A stiffness K over some motions, L (L^T K L)^-1 L^T, factorised once on the host in double precision.

    Parameters
    ----------
    stiffness
        K (3N, 3N) [N/m].
    motions
        L (3N, n): independent motions as columns. Their own unknowns, three to a node, are numbered by `node` (n,).
    device
        Where the right-hand sides live.
    precision
        In which the factor is kept; what it does is symmetric and positive definite in both. Single precision has half
        the bytes to read.
    settings
        How it is made and swept.

    Raises
    ------
    RuntimeError
        K is singular over these motions: something is not held.
    """

    on_device = False

    def __init__(
        self,
        stiffness: sp.csc_array,
        motions: sp.csc_array,
        node: np.ndarray,
        device: Device,
        precision: Precision = "float32",
        settings: Factorisation = Factorisation(),
    ):
        free = sp.csc_array(motions.T @ stiffness @ motions)
        order, fronts = build_fronts(free, node, choose_threads(len(node)), settings.fronts)
        motions = sp.csc_array(motions[:, order].astype(device.precision))
        self._motions, self._transposed = sp.csr_array(motions), sp.csr_array(motions.T)
        self._precision, self._settings = precision, settings
        with limit_to_one_thread():
            values, self._panels = factorise_panels(
                sp.csc_array(free[order][:, order]), fronts, precision, settings.singular
            )
        self._sweep = Sweep(fronts, values, precision)

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """One sweep up and one down for the live columns: the others would cost as much."""
        values = r.numpy()
        solved = np.zeros_like(values)
        x = self._transposed @ values[:, live]
        # Single precision holds no forces of 1e-40 N beside columns of 1 N.
        size = np.abs(x).max(axis=0, initial=0.0)
        size[size == 0.0] = 1.0
        solved[:, live] = self._motions @ (self._solved((x / size).astype(self._precision)) * size)
        out.assign(solved)

    def compliance(self, rows: np.ndarray) -> np.ndarray:
        """What it does (m, m) [m/N] at some of the 3N rows (m,) alone, in the factor's precision.

        Only fronts that these rows or what depends on them belong to are swept.
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
        out, size = np.empty((len(rows), len(rows)), self._precision), self._settings.strip

        def fill(firsts: range) -> None:
            for first in firsts:
                strip = slice(first, first + size)
                x = unit[:, strip].toarray(order="C").astype(self._precision)
                out[:, strip] = chosen @ _swept(panels, x)

        share = choose_threads(len(rows))
        with limit_to_one_thread():
            run_together([partial(fill, range(size * k, len(rows), size * share)) for k in range(share)])
        return out

    def _solved(self, x: np.ndarray) -> np.ndarray:
        if x.shape[1] <= self._settings.few:
            return self._sweep.solved(x)
        # Threads of BLAS wait for one another at every front, ages where something else runs on their cores.
        with limit_to_one_thread():
            return _swept(self._panels, x)


def find_moved_nodes(basis: sp.csc_array) -> np.ndarray:
    """Return the node (n,) that each column of a constraint's basis (3N, n) moves."""
    return np.asarray(basis.indices[basis.indptr[:-1]] // 3)


@dataclass(frozen=True, eq=False)
class FrontPanel:
    """What is kept of a front of k own and m border unknowns: `values` (k, k + m) = R^-T [1, -R^-1 C^T].

    S = R R^T (k, k) and C (m, k) are the rows of the matrix at the front's own and border unknowns, less what was
    eliminated before them. Down is the transpose of up, whatever was rounded: the whole stays symmetric and positive
    definite.
    """

    front: Front
    values: np.ndarray

    def up(self, x: np.ndarray) -> None:
        """x_own = R^-1 x_own, x_border -= C S^-1 x_own, in x (n, b)."""
        own = slice(self.front.first, self.front.stop)
        product = self.values.T @ x[own]
        x[own] = product[: len(self.values)]
        x[self.front.border] += product[len(self.values) :]

    def down(self, x: np.ndarray) -> None:
        """x_own = R^-T x_own - S^-1 C^T x_border, in x (n, b)."""
        x[self.front.first : self.front.stop] = self.values @ x[self.front.rows]


def _swept(panels: Sequence[FrontPanel], x: np.ndarray) -> np.ndarray:
    """x (n, b) after both sweeps through these panels, in place."""
    for panel in panels:
        panel.up(x)
    for panel in reversed(panels):
        panel.down(x)
    return x


def factorise_panels(
    matrix: sp.csc_array, fronts: Sequence[Sequence[Front]], precision: Precision, singular: float
) -> tuple[np.ndarray, list[FrontPanel]]:
    """Return the values of all panels, one after the other in one array; and the panels.

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
    work = _Fronts(matrix, panels, singular)
    lower = [partial(work.eliminate, range(first, stop)) for first, stop in pairwise(ends[:-1])]
    left: list[Updates] = [{} for _ in lower]
    run_together([partial(task, updates) for task, updates in zip(lower, left, strict=True)])
    meeting: Updates = {}
    for updates in left:
        for number, waiting in updates.items():
            meeting.setdefault(number, []).extend(waiting)
    work.eliminate(range(ends[-2], ends[-1]), meeting)
    return values, panels


class _Fronts:
    """Fronts of a sparse matrix, one after the other; those of different parts may be eliminated at the same time."""

    def __init__(self, matrix: sp.csc_array, panels: Sequence[FrontPanel], singular: float):
        self._matrix, self._panels = matrix, panels
        self._least = singular * matrix.diagonal()
        sizes = [len(panel.values) for panel in panels]
        self._owner = np.repeat(np.arange(len(panels)), sizes)

    def eliminate(self, numbers: range, updates: Updates) -> None:
        """Fill the panels of these fronts; `updates` brings what waits for them, and leaves with what waits later."""
        for number in numbers:
            panel = self._panels[number]
            front, size = panel.front, len(panel.values)
            whole = self._rows(front)
            for border, update in updates.pop(number, ()):
                add_lower(update, np.searchsorted(front.rows, border), whole)
            root, info = potrf(whole[:size, :size], lower=1)
            if info or (np.diagonal(root) ** 2 <= self._least[front.first : front.stop]).any():
                raise RuntimeError("it is not positive definite")
            panel.values[:, :size] = trtri(root, lower=1)[0].T
            if len(front.border):
                across = trsm(1.0, root, whole[size:, :size], side=1, lower=1, trans_a=1)
                update = syrk(-1.0, across, beta=1.0, c=whole[size:, size:], lower=1)
                updates.setdefault(int(self._owner[front.border[0]]), []).append((front.border, update))
                panel.values[:, size:] = -trsm(1.0, root, across, side=1, lower=1).T

    def _rows(self, front: Front) -> np.ndarray:
        """Return the matrix (k + m, k + m) at a front's unknowns, as far as its own columns hold; the lower half."""
        start, rows, size = self._matrix.indptr, front.rows, front.stop - front.first
        whole = np.zeros((len(rows), len(rows)), order="F")
        entries = slice(start[front.first], start[front.stop])
        row, value = self._matrix.indices[entries], self._matrix.data[entries]
        column = np.repeat(np.arange(size), np.diff(start[front.first : front.stop + 1]))
        later = row >= front.first + column
        whole[np.searchsorted(rows, row[later]), column[later]] = value[later]
        return whole

"""Interfaces of energy terms: energy, gradient and tangent stiffness, and data for solver accelerations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..errors import InputError
from ..loads import Loads
from .element import Elements


@dataclass(frozen=True, eq=False)
class Cases:
    """Load cases of a batch: loads, start times, and history variables of the terms.

    `loads` has B load cases; `start_time` (B,) [s]. `memory`: history variables (B, ...) by term name, from `Term.end`.
    `displacement` (B, N, 3) [m] of the nodes at the start; None: undeformed. `share` (B,): fraction of their path that
    the tools have covered; None: 1. `restarted` (B,) bool marks descents that start undeformed and without contact;
    None: no descent. `warm`: arrays (B, ...) of an earlier solution that accelerate this solution.
    """

    loads: Loads
    start_time: np.ndarray
    memory: Mapping[str, Any] = field(default_factory=dict)
    displacement: np.ndarray | None = None
    share: np.ndarray | None = None
    restarted: np.ndarray | None = None
    warm: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path_fraction(self) -> np.ndarray:
        """Fraction (B,) of the path that the tools have covered."""
        return np.ones(len(self.loads)) if self.share is None else self.share

    @property
    def steps(self) -> np.ndarray:
        """Time (B,) [s] since the start.

        Raises
        ------
        InputError
            The time of a load is before its start time.
        """
        steps = self.loads.times - self.start_time
        if (steps < 0.0).any():
            row = int(steps.argmin())
            raise InputError(
                f"load case {row} is at {self.loads.times[row]:g} s, before its start at {self.start_time[row]:g} s: "
                "to go back in time, start from an earlier deformation, or from rest."
            )
        return steps

    def select(self, index: slice | np.ndarray) -> Cases:
        """Return the load cases selected by `index`."""
        memory = {name: value[index] for name, value in self.memory.items()}
        displacement = None if self.displacement is None else self.displacement[index]
        share = None if self.share is None else self.share[index]
        restarted = None if self.restarted is None else self.restarted[index]
        warm = {name: value[index] for name, value in self.warm.items()}
        return Cases(self.loads.select(index), self.start_time[index], memory, displacement, share, restarted, warm)

    def get_past(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return the history variables of the term `name`, (B, *shape) float64; zeros if there are none.

        Raises
        ------
        InputError
            The history variables belong to another mesh, discretisation or set of tools.
        """
        whole = (len(self.loads), *shape)
        found = self.memory.get(name)
        if found is not None and found.shape != whole:
            raise InputError(
                f"the start's memory of {name} has shape {found.shape}, not {whole}: start from a solution of the same "
                "mesh, element and tools, or from rest."
            )
        return np.zeros(whole) if found is None else np.asarray(found, np.float64)

    # Former names, for one release.
    rows, past, gone, anew = select, get_past, path_fraction, property(attrgetter("restarted"))


@runtime_checkable
class Term(Protocol):
    """Interface of energy terms: summands of the total potential energy, for b load cases at once.

    Arrays are Warp arrays on the device of the problem, (3N, b) for N nodes with one column per active load case.
    Methods add their results to `out`, except `longest_step`, which takes the minimum.
    """

    @property
    def name(self) -> str:
        """Unique name of the term in a problem; key of its history variables."""
        ...

    @property
    def constant(self) -> bool:
        """True if the gradient depends only on the load cases, not on the displacement."""
        ...

    @property
    def passive(self) -> bool:
        """True if the gradient is zero in the undeformed state for all load cases, as for elastic tissue."""
        ...

    @property
    def steep(self) -> bool:
        """True if the tangent stiffness may differ strongly from the undeformed stiffness, as in contact."""
        ...

    def begin(self, cases: Cases) -> None:
        """Set loads, times and history variables of every load case."""
        ...

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,), in this order, for all further calls in the batch."""
        ...

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy [J] of u (3N, b) [m] to out (b,), float64; +inf outside the domain."""
        ...

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient of the energy [N] at u (3N, b) to out (3N, b); not finite outside the domain.

        Unless `constant`, the computation is on the device alone, and uses the same arrays for all batches with the
        same number of columns, since CUDA graphs replay the computation.
        """
        ...

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Set the linearisation point u (3N, b); `definite` (b,) int32: 1 for a positive semi-definite tangent."""
        ...

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the product of the tangent stiffness, at the last `linearise`, and p (3N, b) [m] to out (3N, b) [N]."""
        ...

    def add_diagonal(self, out: wp.array) -> None:
        """Add the 3 x 3 diagonal blocks of the tangent stiffness at the last `linearise` to out (N, b) [N/m]."""
        ...

    def rest_curvature(self) -> sp.csc_array | None:
        """Return the undeformed stiffness (3N, 3N) [N/m] for factorised preconditioners, or None to be omitted there.

        A steep term may return a better approximation of its tangent stiffness in later states.
        """
        ...

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Reduce out (b,) to the largest fraction of the step du (3N, b) inside the domain; on the device alone."""
        ...

    def end(self, u: wp.array) -> Any:
        """Return the history variables (B, ...) for the next solution, or None."""
        ...


@runtime_checkable
class StepTerm(Term, Protocol):
    """Interface of terms whose stiffness grows as time steps shrink; preconditioners must include this stiffness."""

    def compute_step_stiffness(self, time_step: float) -> sp.csc_array:
        """Return the stiffness (3N, 3N) [N/m] that a time step [s] adds to the undeformed stiffness."""
        ...


@runtime_checkable
class HistoryTerm(Term, Protocol):
    """Interface of terms whose history variables (B, n, width) have one row for each of n elements or nodes."""

    @property
    def keys(self) -> np.ndarray:
        """Unique key (n, k) of each row, by vertices and other numbers; the keys do not change in a resection."""
        ...

    @property
    def width(self) -> int:
        """Number of history variables in a row."""
        ...


@runtime_checkable
class StrainTerm(Term, Protocol):
    """Interface of element terms whose stiffness depends on the strain; H is the displacement gradient."""

    @property
    def prevents_inversion(self) -> bool:
        """True if the energy is infinite for inverted elements."""
        ...

    def compute_second_order(self) -> tuple[Elements, np.ndarray, np.ndarray]:
        """Return elements (T,), half of the second derivative of the stress (k, 9, 9, 9) [Pa], and tissue indices (T,).

        The derivative of stress component a by gradient components b and c, row-major, is in the undeformed state.
        """
        ...

    def compute_coefficient_work(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the derivatives (T, k, b) of the work of v against the forces at u, both (3N, b) [m], in float64.

        The derivatives are with respect to the k coefficients of each element.
        """
        ...

    def find_elements_on(self, nodes: np.ndarray) -> np.ndarray:
        """Return the elements (k,) all of whose nodes are marked in `nodes` (N,) bool."""
        ...

    def update_max_strain(self, elements: wp.array, u: wp.array, columns: wp.array, out: wp.array) -> None:
        """Raise out (N, k) to the largest |H| of the given elements at each node, for load cases (k,) of u (3N, b)."""
        ...

    def add_stiffening(
        self, elements: wp.array, u: wp.array, columns: wp.array, min_strain: wp.array, index: wp.array, out: wp.array
    ) -> None:
        """Add tangent minus undeformed stiffness [N/m] of the given elements to out (k, p, p) float64.

        Quadrature points with |H| <= `min_strain` (k,) are omitted. A node has the rows in out from 3 `index` (N, k).
        """
        ...


class Barrier(Term, Protocol):
    """Interface of contact terms with a gap, which a descent may widen at first; the tools may move."""

    def compute_stride(self, cases: Cases, u: wp.array) -> np.ndarray:
        """Return the fraction (B,) of the path that tools may move at once, at most 1, for tissue at u (3N, B) [m]."""
        ...

    def compute_path_in_gaps(self, cases: Cases) -> np.ndarray:
        """Return the total motion (B,) of the tools on their path, or of the tissue, in units of the gap."""
        ...

    def find_penetrating(self, u: wp.array) -> np.ndarray:
        """Return a mask (b,) of load cases with a tool inside the tissue at u (3N, b) [m], with or without contact."""
        ...

    def find_overlaps(self, u: wp.array) -> np.ndarray:
        """Return two masks (2, b) of load cases: a tool overlaps the touchable surface at u (3N, b) [m], or bone."""
        ...

    def widen_gap(self, factor: float) -> None:
        """Multiply the gap by `factor` until the next batch begins."""
        ...

    def compute_reaction(self, u: wp.array) -> np.ndarray:
        """Return the force [N] and the moment about its origin [N m] of each tool, at u (3N, b) [m]: (b, tools, 6)."""
        ...


@dataclass(frozen=True, eq=False)
class BlockFunctions:
    """Warp functions of a `Barrier` for thread blocks; all threads of a block must call each function.

    Parameters
    ----------
    barrier_struct, pairs_struct
        Types of the struct arguments: the barrier, and its near pairs, which the functions update.
    add_force
        Function (x, stage, near, column, thread, out) that adds the gradient at x (3n, b) to out (3n, b).
    add_matrix
        Function (x, stage, near, definite, place, column, thread, out) that adds the tangent stiffness to out
        (b, 3m, 3m), as in `ReducedBarrier.compute_stiffness`; call `add_force` at the same x before.
    bound_step
        Function (x, way, stage, near, column, thread) that returns the fraction of a step, at most 1, in the domain.
    """

    barrier_struct: Any
    pairs_struct: Any
    add_force: wp.Function
    add_matrix: wp.Function
    bound_step: wp.Function


class ReducedBarrier(Protocol):
    """Interface of a barrier of b load cases as a function of the displacement w (3n, b) [m] of n touchable nodes.

    Arrays are float64 arrays of the library that `views.get_library` returns.
    """

    @property
    def functions(self) -> BlockFunctions:
        """Warp functions of the barrier, for kernels."""
        ...

    def build_structs(self, columns: np.ndarray) -> tuple[Any, Any]:
        """Return the structs of the barrier and its near pairs, for the load cases `columns` (k,)."""
        ...

    def compute_gradient(self, w: Any) -> Any:
        """Return the gradient (3n, b) [N] of the barrier energy at w."""
        ...

    def compute_stiffness(self, w: Any, index: Any, size: int, definite: np.ndarray) -> Any:
        """Return the tangent stiffness (b, 3 size, 3 size) [N/m] between the nodes with `index` (n, b) >= 0.

        The stiffness is positive semi-definite for load cases marked in `definite` (b,).
        """
        ...


@runtime_checkable
class LocalBarrier(Barrier, Protocol):
    """Interface of barriers that act only on a subset of the nodes."""

    @property
    def touchable_nodes(self) -> np.ndarray:
        """Sorted node numbers (n,) on which the barrier can act."""
        ...

    def select_nodes(self, max_nodes: int) -> np.ndarray:
        """Return the touchable nodes, followed by the nearest other nodes: at most `max_nodes` in total (k,)."""
        ...

    def reduce(self, columns: np.ndarray) -> ReducedBarrier | None:
        """Return the current barrier on the touchable nodes, for load cases `columns` (k,); None without contact.

        The returned object is reused, so the next call changes it.
        """
        ...

    def get_active_stiffness(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the active touchable nodes (a,) at the last linearisation of one load case, and their stiffness.

        The tangent stiffness (3a, 3a) [N/m] is positive semi-definite.
        """
        ...


@runtime_checkable
class AssembledTerm(Term, Protocol):
    """Interface of terms that provide their tangent stiffness as a matrix."""

    def assemble_stiffness(self) -> sp.csc_array:
        """Return the tangent stiffness K(u) (3N, 3N) [N/m] at the last linearisation of one load case."""
        ...

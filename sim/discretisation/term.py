"""Interface of energy terms: energy, gradient and tangent stiffness, for effects and their accelerations."""

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
    """Load cases of a batch: loads, start times, and memories of the terms.

    loads have B rows; start_time is (B,) [s]. memory: by term name, arrays with B rows, as `Term.end` returned them.
    displacement (B, N, 3) [m] of the nodes at the start; None: undeformed. share (B,): path fraction that tools have
    covered, 1 if None. `restarted` (B,) bool: descents that start undeformed and without contact; none if None.
    warm: data of an earlier solution that speed up this one, rows (B, ...).
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
        """Path fractions (B,) that tools have covered."""
        return np.ones(len(self.loads)) if self.share is None else self.share

    @property
    def steps(self) -> np.ndarray:
        """Time (B,) [s] since the start.

        Raises
        ------
        InputError
            Loads before their start.
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
        """Return a subset of the cases."""
        memory = {name: value[index] for name, value in self.memory.items()}
        displacement = None if self.displacement is None else self.displacement[index]
        share = None if self.share is None else self.share[index]
        restarted = None if self.restarted is None else self.restarted[index]
        warm = {name: value[index] for name, value in self.warm.items()}
        return Cases(self.loads.select(index), self.start_time[index], memory, displacement, share, restarted, warm)

    def get_past(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return the memory of the term `name`, (B, *shape) float64; zeros without one.

        Raises
        ------
        InputError
            A memory of another body, discretisation or set of tools.
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
    """Summand of the total potential energy, for b load cases at once.

    Arrays are Warp's, on the problem's device, batch last: (3N, b), one column per active load case; N counts the
    discretisation's nodes. Results are added to `out`, except in `longest_step`, which takes the minimum.
    """

    @property
    def name(self) -> str:
        """Name, unique in a problem; key of its memory."""
        ...

    @property
    def constant(self) -> bool:
        """True if the gradient depends on the cases only, not on the displacement."""
        ...

    @property
    def passive(self) -> bool:
        """True if it only resists, as elastic tissue does: zero gradient in the undeformed state, for all cases."""
        ...

    @property
    def steep(self) -> bool:
        """True if its tangent may differ strongly from the undeformed stiffness, as in contact."""
        ...

    def begin(self, cases: Cases) -> None:
        """Set loads, times and memory of every load case."""
        ...

    def keep(self, columns: np.ndarray) -> None:
        """Keep these load cases (k,), in this order: the others have left the batch."""
        ...

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy [J] of u (3N, b) [m] to out (b,), float64; +inf outside the domain."""
        ...

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient of the energy [N] at u (3N, b) to out (3N, b); not finite outside the domain.

        Unless `constant`: computed on the device alone, and with the same arrays for all batches of one width, since
        CUDA graphs replay it.
        """
        ...

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Set the linearisation point u (3N, b); definite (b,) int32: 1 requests a positive semi-definite tangent."""
        ...

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness at the last `linearise` times p (3N, b) [m] to out (3N, b) [N]."""
        ...

    def add_diagonal(self, out: wp.array) -> None:
        """Add the 3 x 3 diagonal blocks of the tangent stiffness at the last `linearise` to out (N, b) [N/m]."""
        ...

    def rest_curvature(self) -> sp.csc_array | None:
        """Return the undeformed stiffness (3N, 3N) [N/m] for factorised preconditioners, or None to be left out.

        A steep term may return a better approximation of its later tangent.
        """
        ...

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Reduce out (b,) to the largest fraction of du (3N, b) that stays inside the domain; on the device alone."""
        ...

    def end(self, u: wp.array) -> Any:
        """Return the memory for the next call, rows first (B, ...), or None."""
        ...


@runtime_checkable
class StepTerm(Term, Protocol):
    """Term whose stiffness grows as time steps shrink, which preconditioners must include."""

    def compute_step_stiffness(self, time_step: float) -> sp.csc_array:
        """Return the addition to the undeformed stiffness (3N, 3N) [N/m] for a time step [s]."""
        ...


@runtime_checkable
class HistoryTerm(Term, Protocol):
    """Term whose memory, if any, belongs to elements or nodes: (B, n, width), one row for each."""

    @property
    def keys(self) -> np.ndarray:
        """Unique key (n, k) of each row by vertices and other numbers, whatever is cut from the mesh."""
        ...

    @property
    def width(self) -> int:
        """Length of a row."""
        ...


@runtime_checkable
class StrainTerm(Term, Protocol):
    """Term of elements whose stiffness depends on the strain; H is the displacement gradient."""

    @property
    def prevents_inversion(self) -> bool:
        """True if its energy is infinite for inverted elements."""
        ...

    def compute_second_order(self) -> tuple[Elements, np.ndarray, np.ndarray]:
        """Return elements (T,), half the second stress derivative (k, 9, 9, 9) [Pa] by tissue, tissue indices (T,).

        Derivative of stress component a by gradient components b and c, row-major, in the undeformed configuration.
        """
        ...

    def find_elements_on(self, nodes: np.ndarray) -> np.ndarray:
        """Return the elements (k,) whose nodes are all marked in `nodes` (N,) bool."""
        ...

    def update_max_strain(self, elements: wp.array, u: wp.array, columns: wp.array, out: wp.array) -> None:
        """Raise out (N, k) to |H| at the nodes of some elements (m,) int32, for load cases (k,) int32 of u (3N, b)."""
        ...

    def add_stiffening(
        self, elements: wp.array, u: wp.array, columns: wp.array, min_strain: wp.array, index: wp.array, out: wp.array
    ) -> None:
        """Add the tangent stiffness minus the undeformed one [N/m] of these elements to out (k, p, p) float64.

        Only points with |H| above `min_strain` (k,) count. The rows of a node in out begin at 3 `index` (N, k).
        """
        ...


class Barrier(Term, Protocol):
    """Term for contact with a gap, which a descent may widen at first; tools may move."""

    def compute_stride(self, cases: Cases, u: wp.array) -> np.ndarray:
        """Return the path fraction (B,), at most 1, that tools may move at once, with the body at u (3N, B) [m]."""
        ...

    def compute_path_in_gaps(self, cases: Cases) -> np.ndarray:
        """Return the motion (B,) of the tools on their whole path, or of the tissue, in units of the gap."""
        ...

    def find_penetrating(self, u: wp.array) -> np.ndarray:
        """Return a mask (b,) of load cases with a tool inside the body at u (3N, b) [m], even without contact."""
        ...

    def find_overlaps(self, u: wp.array) -> np.ndarray:
        """Return masks (2, b) of load cases where a tool overlaps touchable surface at u (3N, b) [m], or bone."""
        ...

    def widen_gap(self, factor: float) -> None:
        """Widen the gap by a factor until the next batch begins."""
        ...

    def compute_reaction(self, u: wp.array) -> np.ndarray:
        """Return force [N] and moment about its origin [N m] that each tool exerts at u (3N, b) [m]: (b, tools, 6)."""
        ...


@dataclass(frozen=True, eq=False)
class BlockFunctions:
    """Warp functions of a Barrier for thread blocks; all threads of a block must call them.

    Parameters
    ----------
    barrier_struct, pairs_struct
        Structs of their arguments: the barrier, and its near pairs, which they update.
    add_force
        (x, stage, near, column, thread, out): add the gradient at x (3n, b) to out (3n, b).
    add_matrix
        (x, stage, near, definite, place, column, thread, out): add the tangent stiffness to out (b, 3m, 3m), as
        `ReducedBarrier.compute_stiffness`, after `add_force` at the same x.
    bound_step
        (x, way, stage, near, column, thread): return the fraction of a step, at most 1, that stays inside the domain.
    """

    barrier_struct: Any
    pairs_struct: Any
    add_force: wp.Function
    add_matrix: wp.Function
    bound_step: wp.Function


class ReducedBarrier(Protocol):
    """Barrier of b load cases on the n touchable nodes, as a function of their displacement w (3n, b) [m].

    Arrays are those of `views.library`, float64.
    """

    @property
    def functions(self) -> BlockFunctions:
        """Warp functions for kernels."""
        ...

    def build_structs(self, columns: np.ndarray) -> tuple[Any, Any]:
        """Return the structs of barrier and near pairs for some load cases (k,)."""
        ...

    def compute_gradient(self, w: Any) -> Any:
        """Return the gradient (3n, b) [N]."""
        ...

    def compute_stiffness(self, w: Any, index: Any, size: int, definite: np.ndarray) -> Any:
        """Return the tangent stiffness (b, 3 size, 3 size) [N/m] between the nodes with `index` (n, b) >= 0.

        It is positive semi-definite for load cases marked `definite` (b,).
        """
        ...


@runtime_checkable
class LocalBarrier(Barrier, Protocol):
    """Barrier that acts on a subset of the nodes only."""

    @property
    def touchable_nodes(self) -> np.ndarray:
        """Nodes (n,), ascending, on which it can act."""
        ...

    def select_nodes(self, max_nodes: int) -> np.ndarray:
        """Return the touchable nodes, followed by the nearest others up to `max_nodes` in total: (k,)."""
        ...

    def reduce(self, columns: np.ndarray) -> ReducedBarrier | None:
        """Return the barrier on these nodes, for some load cases (k,), in its current state; None without contact.

        The object is reused: it reflects the latest call.
        """
        ...

    def get_active_stiffness(self) -> tuple[np.ndarray, np.ndarray]:
        """Return active nodes (a,) of these n at the last linearisation, of one load case, and their tangent stiffness.

        The matrix (3a, 3a) [N/m] is positive semi-definite.
        """
        ...


class AssembledTerm(Term, Protocol):
    """Term that provides its tangent stiffness as a matrix."""

    def assemble_stiffness(self) -> sp.csc_array:
        """Assemble K(u) (3N, 3N) [N/m] at the last linearisation, of one load case."""
        ...

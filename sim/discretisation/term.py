"""The Term protocol: what it costs to have an effect (energy, gradient, curvature)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..errors import InputError
from ..loads import Loads
from .element import Elements


@dataclass(frozen=True, eq=False)
class Cases:
    """The load cases of a batch: what acts, since when, and what each term remembers of the past.

    loads have B rows; start_time is (B,) [s]. memory is, by term name, arrays with B rows, as `Term.end` returned them.
    displacement (B, N, 3) [m] is that of the element's nodes at the start, or None: at rest. share (B,) is that of the
    way from where they were that tools have gone, 1 if None. anew (B,) bool says whose descent begins at rest, where
    nothing is touched yet; none if None. warm is what an earlier answer left to make this one faster, rows (B, ...).
    """

    loads: Loads
    start_time: np.ndarray
    memory: Mapping[str, Any] = field(default_factory=dict)
    displacement: np.ndarray | None = None
    share: np.ndarray | None = None
    anew: np.ndarray | None = None
    warm: Mapping[str, Any] = field(default_factory=dict)

    @property
    def gone(self) -> np.ndarray:
        """Shares (B,) of their way that tools have gone."""
        return np.ones(len(self.loads)) if self.share is None else self.share

    @property
    def steps(self) -> np.ndarray:
        """How much time (B,) [s] has passed since the start.

        Raises
        ------
        InputError
            Loads that lie before their start.
        """
        steps = self.loads.times - self.start_time
        if (steps < 0.0).any():
            row = int(steps.argmin())
            raise InputError(
                f"load case {row} is at {self.loads.times[row]:g} s, before its start at {self.start_time[row]:g} s: "
                "to go back in time, start from an earlier deformation, or from rest."
            )
        return steps

    def rows(self, index: slice | np.ndarray) -> Cases:
        """Return some of the cases."""
        memory = {name: value[index] for name, value in self.memory.items()}
        displacement = None if self.displacement is None else self.displacement[index]
        share = None if self.share is None else self.share[index]
        anew = None if self.anew is None else self.anew[index]
        warm = {name: value[index] for name, value in self.warm.items()}
        return Cases(self.loads.rows(index), self.start_time[index], memory, displacement, share, anew, warm)

    def past(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """What the term `name` remembers, (B, *shape) float64; zeros if nothing.

        Raises
        ------
        InputError
            A memory of another body or discretisation, or of other tools.
        """
        whole = (len(self.loads), *shape)
        found = self.memory.get(name)
        if found is not None and found.shape != whole:
            raise InputError(
                f"the start's memory of {name} has shape {found.shape}, not {whole}: start from an answer of the same "
                "mesh, element and tools, or from rest."
            )
        return np.zeros(whole) if found is None else np.asarray(found, np.float64)


@runtime_checkable
class Term(Protocol):
    """One summand of the total potential, for b load cases at once.

    Arrays are Warp's, on the problem's device, batch last: (3N, b), one column per live load case; N counts the
    element's nodes. Every `out` is added to, except in `longest_step`, where the least value wins.
    """

    @property
    def name(self) -> str:
        """Unique in a problem; the key of its memory."""
        ...

    @property
    def constant(self) -> bool:
        """Whether the gradient depends on the cases alone, not on where the nodes are."""
        ...

    @property
    def passive(self) -> bool:
        """Whether it only ever resists, as elastic tissue does: no gradient at rest, whatever the cases."""
        ...

    @property
    def steep(self) -> bool:
        """Whether its curvature may be far from what the rest stiffness knows, as where bodies touch."""
        ...

    def begin(self, cases: Cases) -> None:
        """Take the loads, times and memory of every column."""
        ...

    def keep(self, columns: np.ndarray) -> None:
        """Keep these columns (k,), in this order: the others have left the batch."""
        ...

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy [J] of u (3N, b) [m] to out (b,), float64; +inf outside the domain."""
        ...

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the energy's gradient [N] at u (3N, b) to out (3N, b); not finite outside the domain.

        If it is not `constant`: on the device alone, for batches of one width always in the same arrays, as a graphics
        card replays it.
        """
        ...

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Remember u (3N, b) for `add_curvature`; definite (b,) int32: 1 asks for positive semi-definite curvature."""
        ...

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the curvature at the last `linearise` times p (3N, b) [m] to out (3N, b) [N]."""
        ...

    def add_diagonal(self, out: wp.array) -> None:
        """Add the 3 x 3 diagonal blocks of the curvature at the last `linearise` to out (N, b) of matrices [N/m]."""
        ...

    def rest_curvature(self) -> sp.csc_array | None:
        """Curvature at rest (3N, 3N) [N/m], assembled, for factorised preconditioners; None leaves the term out.

        A steep term may offer what stands better for where it is going.
        """
        ...

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Lower out (b,) to the longest fraction of du (3N, b) that stays inside the domain; on the device alone."""
        ...

    def end(self, u: wp.array) -> Any:
        """What must travel to the next call, rows first (B, ...), or None."""
        ...


@runtime_checkable
class Paced(Term, Protocol):
    """A Term whose curvature grows as steps in time shrink, which preconditioners must know."""

    def curvature_at_pace(self, step: float) -> sp.csc_array:
        """What it adds to the curvature at rest (3N, 3N) [N/m] over a step in time [s]."""
        ...


@runtime_checkable
class Remembering(Term, Protocol):
    """A Term whose memory, if it has any, is of elements or nodes: rows (B, n, width), one for each."""

    @property
    def marks(self) -> np.ndarray:
        """Vertices and other numbers (n, k) that tell each row from all others, whatever is cut from the mesh."""
        ...

    @property
    def width(self) -> int:
        """How long a row is."""
        ...


@runtime_checkable
class Strained(Term, Protocol):
    """A Term of elements, which resist more or less where they are strained; H is the displacement gradient."""

    @property
    def bounded(self) -> bool:
        """Whether it is infinite where its elements are inside out."""
        ...

    def second_order(self) -> tuple[Elements, np.ndarray, np.ndarray]:
        """Its elements (T,), half the second derivative (k, 9, 9, 9) [Pa] of each tissue's stress at rest, and whose.

        Of stress component a by gradient components b and c, row by row; the last (T,) says which tissue.
        """
        ...

    def elements_on(self, nodes: np.ndarray) -> np.ndarray:
        """Those elements (k,) that lie wholly on some nodes (N,) bool."""
        ...

    def raise_strain(self, some: wp.array, u: wp.array, columns: wp.array, out: wp.array) -> None:
        """Raise out (N, k) to |H| at the nodes of some elements (m,) int32, in some columns (k,) int32 of u (3N, b)."""
        ...

    def add_stiffening(
        self, some: wp.array, u: wp.array, columns: wp.array, least: wp.array, place: wp.array, out: wp.array
    ) -> None:
        """Add what the curvature at u is more than at rest [N/m], of the same, to out (k, p, p) float64.

        Only where |H| is more than the `least` (k,) of its column. Rows 3 `place` (N, k) of out are a node's first.
        """
        ...


class Barrier(Term, Protocol):
    """A Term of bodies that tissue touches: they keep a gap, which a descent may open first; some move, as tools do."""

    def stride(self, cases: Cases, u: wp.array) -> np.ndarray:
        """The longest share (B,), at most 1, of their way that the tools may go at once, the body at u (3N, B) [m]."""
        ...

    def gaps(self, cases: Cases) -> np.ndarray:
        """How many times (B,) the gap the tools go on their whole way, or tissue may."""
        ...

    def buried(self, u: wp.array) -> np.ndarray:
        """In which columns (b,) a tool is inside the body at u (3N, b) [m], where it may touch none of its surface."""
        ...

    def overlaps(self, u: wp.array) -> np.ndarray:
        """Columns (2, b) bool in which a tool contains touchable surface at u (3N, b) [m], or undeformed bone."""
        ...

    def widen(self, times: float) -> None:
        """Until the next batch begins the gap is so many times as wide."""
        ...

    def reaction(self, u: wp.array) -> np.ndarray:
        """(b, tools, 6): force [N] and moment about its origin [N m] that each tool exerts at u (3N, b) [m]."""
        ...


@dataclass(frozen=True, eq=False)
class BlockFunctions:
    """What blocks of threads compute of a Barrier, as functions of Warp. All threads of a block must call them.

    Parameters
    ----------
    stage, near
        Structs that they take: what the barrier is, and what of it may be felt, which they keep up to date.
    add_force
        (x, stage, near, column, thread, out): add its gradient at x (3n, b) to out (3n, b).
    add_matrix
        (x, stage, near, definite, place, column, thread, out): add its curvature to out (b, 3m, 3m), as
        `Reduction.curvature`, after `add_force` at the same place.
    longest
        (x, way, stage, near, column, thread): the share of a way, at most 1, that stays inside the domain.
    """

    stage: Any
    near: Any
    add_force: wp.Function
    add_matrix: wp.Function
    longest: wp.Function


class Reduction(Protocol):
    """A Barrier of b columns on the n nodes that can be touched: a function of where they go, w (3n, b) [m].

    Arrays are those of `views.library`, float64.
    """

    @property
    def functions(self) -> BlockFunctions:
        """Its functions for kernels."""
        ...

    def stage(self, columns: np.ndarray) -> tuple[Any, Any]:
        """Return the structs `stage` and `near` for some columns (k,)."""
        ...

    def slope(self, w: Any) -> Any:
        """Its gradient (3n, b) [N]."""
        ...

    def curvature(self, w: Any, place: Any, size: int, definite: np.ndarray) -> Any:
        """Its curvature (b, 3 size, 3 size) [N/m] between the nodes that have a `place` (n, b) >= 0 in their column.

        Positive semi-definite where it is to be `definite` (b,).
        """
        ...


@runtime_checkable
class Local(Barrier, Protocol):
    """A Barrier that only some nodes can ever feel."""

    @property
    def touchable(self) -> np.ndarray:
        """These nodes (n,), ascending."""
        ...

    def around(self, most: int) -> np.ndarray:
        """Nodes (k,), so many at most beside the touchable: these first, then the nearest to them."""
        ...

    def reduced(self, columns: np.ndarray) -> Reduction | None:
        """On these nodes alone, in some columns (k,), as it stands now; None where there is nothing to touch.

        There is one: it is as whoever asked last wanted it.
        """
        ...

    def pressed(self) -> tuple[np.ndarray, np.ndarray]:
        """Which (a,) of these n nodes feel it at the last linearisation, of one column, and its curvature there.

        (3a, 3a) [N/m], positive semi-definite.
        """
        ...


class Curved(Term, Protocol):
    """A Term whose curvature can be had as a matrix."""

    def curvature(self) -> sp.csc_array:
        """Assembled K(u) (3N, 3N) [N/m] at the last linearisation, of one column."""
        ...

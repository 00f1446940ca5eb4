"""Where the few nodes that tools touch come to rest, while all else follows as a quadratic model has it.

With C (3n, 3n) the compliance of the model at these nodes and w0 where they would go untouched, w minimises

    (w - w0) . C^-1 (w - w0) / 2 + c(w) + d |w - v|^2 / 2 over the touched,

c the barrier of tools and d a drag from where they are, v. It is found by Newton's method for the forces f that tools
exert, w = w0 - C f: these are none but at touched nodes, and so C is never inverted. It is given where nodes go under
forces that are nearly right, w1 = w0 - C f1: of differences little is rounded away. All b columns of a batch are solved
at once, each until its own is found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..discretisation.term import Reduction
from ..linalg.compliance import Compliance
from ..linalg.relief import relieved
from ..minimisers.line_search import goes_too_far, kept_of
from ..runtime.device import Device
from ..runtime.views import library, on_host, placed


@dataclass(frozen=True)
class ForceLimits:
    """When Newton's method for the tools' forces ends.

    Parameters
    ----------
    iterations, cuts
        Most, and most cuts of one step.
    most
        Nodes: more that are touched are no few.
    late
        A model that is not convex after so many iterations is not going to be.
    rounded
        A compliance is rounded: this share of its mean makes it definite.
    bytes
        Of the matrices that are solved with at once.
    """

    iterations: int = 60
    cuts: int = 20
    most: int = 300
    late: int = 12
    rounded: float = 1e-6
    bytes: int = 2**28


FORCES = ForceLimits()
BENT = ForceLimits(late=FORCES.iterations)
"""A model need not be convex."""


@dataclass(frozen=True, eq=False)
class Touched:
    """Which nodes of some columns are touched: `columns` (k,) of the batch, and where each node stands among them.

    `place` (n, k): -1 where it is not touched; `rows` (k, 3m): the rows of the touched, and after these of any.
    """

    columns: np.ndarray
    place: np.ndarray
    rows: np.ndarray

    @property
    def size(self) -> int:
        """m."""
        return self.rows.shape[1] // 3

    @property
    def own(self) -> np.ndarray:
        """(k, 3m) bool: which rows are of touched nodes."""
        return np.arange(3 * self.size) < 3 * (self.place >= 0).sum(axis=0)[:, None]

    def taken(self, x: Any) -> Any:
        """(k, 3m, 1) of x (3n, b)."""
        return x[self.rows, self.columns[:, None]][:, :, None]

    def add(self, x: Any, out: Any) -> None:
        """Add x (k, 3m, 1) to out (3n, b)."""
        out[self.rows, self.columns[:, None]] += x[:, :, 0]


def touched_of(touched: np.ndarray, limits: ForceLimits = FORCES) -> list[Touched]:
    """Groups of columns of which about as many nodes are `touched` (n, b) bool, as many as are solved at once."""
    counts = touched.sum(axis=0)
    order, out = np.argsort(-counts, kind="stable"), []
    order = order[counts[order] > 0]
    while len(order):
        size = int(counts[order[0]])
        some, order = np.split(order, [max(1, limits.bytes // (8 * (3 * size) ** 2))])
        own = touched[:, some]
        place = np.where(own, own.cumsum(axis=0) - 1, -1)
        nodes = np.argsort(~own, axis=0, kind="stable")[:size].T
        out.append(Touched(some, place, (3 * nodes[:, :, None] + np.arange(3)).reshape(len(some), -1)))
    return out


@dataclass(frozen=True, eq=False)
class Softness:
    """C of a model: what a body at rest does, and what b columns have learnt since, at the n nodes of the compliance.

    `learnt` (b, 2m, 3n) and `middle` (b, 2m, 2m) in double precision; none where nothing was learnt yet.
    """

    rest: Compliance
    device: Device
    learnt: Any = None
    middle: Any = None

    def rows(self, columns: np.ndarray) -> Softness:
        """Of some columns (k,)."""
        return self if self.learnt is None else replace(self, learnt=self.learnt[columns], middle=self.middle[columns])

    def moved(self, force: Any) -> Any:
        """C force (3n, b)."""
        out = self.rest.between(np.asarray(_touched(force).any(axis=1))) @ force
        if self.learnt is not None:
            out = out + ((self.middle @ (self.learnt @ force.T[:, :, None])).mT @ self.learnt)[:, 0].T
        return out

    def between(self, some: Touched, rounded: float) -> Any:
        """C (k, 3m, 3m) between touched nodes of some columns."""
        rows = placed(self.device, some.rows)
        whole = self.rest.between(np.asarray((some.place >= 0).any(axis=1)))
        own = whole[rows[:, :, None], rows[:, None, :]]
        if self.learnt is not None:
            columns = np.arange(len(some.columns))
            learnt = self.learnt[some.columns][columns[:, None], :, some.rows]  # (k, 3m, 2m)
            own = own + learnt @ self.middle[some.columns] @ learnt.mT
        mean = own.diagonal(0, -2, -1).mean(-1)
        return own + rounded * mean[:, None, None] * placed(self.device, np.eye(own.shape[-1]))


def settled(
    barrier: Reduction,
    soft: Softness,
    here: Any,
    there: Any,
    known: Any,
    tolerance: np.ndarray,
    drag: np.ndarray,
    limits: ForceLimits = FORCES,
) -> tuple[Any, np.ndarray]:
    """The forces f (3n, b) [N], and in which columns (b,) they have been found; the barrier keeps the last of these.

    None are found where the model is not convex: its tools are sharper than its tissue is stiff, and it would go far
    astray. From where the nodes are, `here` (3n, b) [m]; w1 is `there` and f1 `known` (3n, b). They are exact to a
    `tolerance` (b,), relative. `drag` (b,) is d in units of how stiff a touched node is.
    """
    device, linalg = soft.device, library(soft.device).linalg
    out, found, live = known + 0.0, np.zeros(here.shape[1], bool), np.arange(here.shape[1])
    force, held = known + 0.0, 0.0 * here
    for some in touched_of(_touched(barrier.slope(here)), limits):
        matrix = soft.between(some, limits.rounded)
        mean = on_host(matrix.diagonal(0, -2, -1).mean(-1))
        own = some.own[:, :, None]
        some.add(placed(device, own * (drag[some.columns] / mean)[:, None, None]), held)
        own = placed(device, own.astype(float))
        matrix = own * matrix * own.mT + (1.0 - own) * placed(device, np.eye(matrix.shape[-1]))
        some.add(linalg.solve(matrix, own * some.taken(there - here)), force)

    def pushed(w: Any) -> Any:
        return barrier.slope(w) + held * (w - here)

    w, convex = there - soft.moved(force - known), np.ones(len(live), bool)
    slope = pushed(w)
    for step in range(limits.iterations + 1):
        left, touched = slope - force, _touched(slope)
        done = _dots(left, left) <= tolerance**2 * _dots(slope, slope)
        out[:, live[done]], found[live[done]] = force[:, done], True
        stay = np.flatnonzero(~done & (touched.sum(axis=0) <= limits.most) & (convex | (step <= limits.late)))
        if not len(stay) or step == limits.iterations:
            break
        if len(stay) < len(live):
            barrier.keep(stay)
            soft, live, tolerance, touched = soft.rows(stay), live[stay], tolerance[stay], touched[:, stay]
            here, held, w, force, slope, left = (x[:, stay] for x in (here, held, w, force, slope, left))
        change, convex = _newton(barrier, soft, w, left, touched, held, limits)
        way = -soft.moved(change)
        promised, t = -_dots(left, way), barrier.longest_step(w, way)
        for cut in range(limits.cuts + 1):
            slope = pushed(w + placed(device, t) * way)
            ahead = _dots(slope - force - placed(device, t) * change, way)
            far = goes_too_far(ahead, promised)
            if cut == limits.cuts or not far.any():
                break
            t = np.where(far, t * kept_of(ahead, promised), t)
        force, w = force + placed(device, t) * change, w + placed(device, t) * way
    return out, found


def _newton(
    barrier: Reduction, soft: Softness, w: Any, left: Any, touched: np.ndarray, held: Any, limits: ForceLimits
) -> tuple[Any, np.ndarray]:
    """The change (3n, b) of the forces that 1 + D C has for what is `left` (3n, b), D = c'' at w.

    And where it is convex (b,): elsewhere tools count as flat.
    """
    device, change, along = soft.device, left + 0.0, soft.moved(left)
    convex = np.ones(w.shape[1], bool)
    for some in touched_of(touched, limits):
        place = np.full(touched.shape, -1, np.int32)
        place[:, some.columns] = some.place
        compliance, own = soft.between(some, limits.rounded), placed(device, some.own[:, :, None])
        more = placed(device, np.eye(3 * some.size)) * (own * some.taken(held))
        curvature = barrier.curvature(w, placed(device, place), some.size, ~convex)[some.columns] + more
        answer, convex[some.columns] = relieved(device, compliance, curvature, some.taken(along))
        if not convex[some.columns].all():
            curvature = barrier.curvature(w, placed(device, place), some.size, ~convex)[some.columns] + more
            answer, _ = relieved(device, compliance, curvature, some.taken(along))
        some.add(-answer, change)
    return change, convex


def _touched(slope: Any) -> np.ndarray:
    """(n, b) bool: nodes with a slope (3n, b)."""
    return on_host((slope != 0.0).reshape(-1, 3, slope.shape[1]).any(1))


def _dots(x: Any, y: Any) -> np.ndarray:
    """Inner products (b,) of columns."""
    return on_host((x * y).sum(0))

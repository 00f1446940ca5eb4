"""Where the few nodes that tools touch come to rest, while all else follows as a quadratic model has it.

With C (3n, 3n) the compliance of the model at these nodes and w0 where they would go untouched, w minimises

    (w - w0) . C^-1 (w - w0) / 2 + c(w) + d |w - v|^2 / 2 over the touched,

c the barrier of tools and d a drag from where they are, v. It is found by Newton's method for the forces f that tools
exert, w = w0 - C f: these are none but at touched nodes, and so C is never inverted. It is given where nodes go under
forces that are nearly right, w1 = w0 - C f1: of differences little is rounded away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.term import Reduction
from ..linalg.compliance import Compliance
from ..minimisers.lbfgs_kernels import PAIRS
from ..runtime.blocks import launch
from ..runtime.device import Device
from ..runtime.threads import run_together
from ..runtime.views import from_view, select_columns, to_host, view
from .contact_kernel import build_kernel
from .contact_structs import CROWDED, FOUND, OPEN, UNKNOWN, ComplianceModel, Ends, Scratch


@dataclass(frozen=True)
class ForceLimits:
    """When Newton's method for the tools' forces ends.

    Parameters
    ----------
    iterations, cuts
        Most, and most cuts of one step.
    few, most
        Touched nodes: room is made for few at first; more than most are no few.
    late
        A model that is not convex after so many iterations is not going to be.
    rounded
        A compliance is rounded: this share of its mean makes it definite.
    bytes
        Of the matrices of all columns that are solved at once.
    """

    iterations: int = 60
    cuts: int = 20
    few: int = 64
    most: int = 300
    late: int = 12
    rounded: float = 1e-6
    bytes: int = 2**30


FORCES = ForceLimits()
BENT = ForceLimits(late=FORCES.iterations)
"""A model need not be convex."""


@dataclass(frozen=True, eq=False)
class ContactCompliance:
    """C of a model: what a body at rest does, and what b columns have learnt since, at the n nodes of the compliance.

    `learnt` (b, 2m, 3n) and `middle` (b, 2m, 2m) in double precision; none where nothing was learnt yet. `own`
    (b, 3n, 3n) in single precision is what strained tissue changes. `room` is `allocate_scratch`, which may be kept.
    """

    rest: Compliance
    device: Device
    room: Callable[[int, int, int], Scratch]
    learnt: Any = None
    middle: Any = None
    own: Any = None

    def ensure_known(self, force: Any) -> None:
        """See to it that the compliance is known where forces (3n, b) act on its first nodes."""
        every = self.rest.known.copy()
        if not every[: len(force) // 3].all():
            every[: len(force) // 3] = to_host((force != 0.0).any(1)).reshape(-1, 3).any(axis=1)
            self.rest.ensure_known(every)

    def model(self, columns: np.ndarray, rounded: float) -> ComplianceModel:
        """Of some columns (k,)."""
        out, n, count = ComplianceModel(), len(self.rest.rows), len(columns)
        out.rest, out.known = from_view(self.device, self.rest.columns), self.device.array(self.rest.known, wp.int32)
        none = wp.zeros((count, 0, 0), dtype=wp.float32, device=self.device.name)
        kinds = ("learnt", self.device.zeros(count, 0, n)), ("middle", self.device.zeros(count, 0, 0)), ("own", none)
        for name, nothing in kinds:
            known = getattr(self, name)
            some = None if known is None else known[select_columns(self.device, columns, len(known))]
            setattr(out, name, nothing if some is None else from_view(self.device, some))
        out.rounded = rounded
        return out


def solve_contact_forces(
    barrier: Reduction,
    soft: ContactCompliance,
    here: Any,
    there: Any,
    known: Any,
    tolerance: np.ndarray,
    drag: np.ndarray,
    limits: ForceLimits = FORCES,
) -> tuple[Any, np.ndarray]:
    """Return the forces f (3n, b) [N], and in which columns (b,) they have been found.

    None are found where the model is not convex: its tools are sharper than its tissue is stiff, and it would go far
    astray. From where the nodes are, `here` (3n, b) [m]; w1 is `there` and f1 `known` (3n, b). They are exact to a
    `tolerance` (b,), relative. `drag` (b,) is d in units of how stiff a touched node is.
    """
    out, status = known + 0.0, np.full(here.shape[1], OPEN)
    soft.ensure_known(known)
    for room in (limits.few, limits.most):
        status[status == CROWDED] = OPEN
        each = max(1, limits.bytes // (4 * 8 * (3 * room) ** 2))
        while (status == OPEN).any():
            some = np.flatnonzero(status == OPEN)[:each]
            on = select_columns(soft.device, some, len(status))
            own = here[:, on], there[:, on], known[:, on]
            asked = tolerance[some], drag[some]
            force, status[some], touched = _solved(barrier, soft, some, own, asked, limits, room)
            ready = np.flatnonzero(status[some] == FOUND)
            if len(ready):
                here_too = select_columns(soft.device, ready, len(some))
                out[:, select_columns(soft.device, some[ready], len(status))] = force[:, here_too]
            lacking = status[some] == UNKNOWN
            if lacking.any():
                soft.ensure_known((to_host(touched)[:, lacking] >= 0).repeat(3, axis=0))
                status[some[lacking]] = OPEN
    return out, status == FOUND


def _solved(
    barrier: Reduction,
    soft: ContactCompliance,
    columns: np.ndarray,
    own: tuple[Any, Any, Any],
    asked: tuple[np.ndarray, np.ndarray],
    limits: ForceLimits,
    room: int,
) -> tuple[Any, np.ndarray, Any]:
    """Return forces (3n, k) of some columns (k,) with room for so many touched nodes, status (k,), and places (n, k).

    Of the columns' `own` here, there and known forces (3n, k), and tolerance and drag (k,) as `asked`.
    """
    device, count = soft.device, len(columns)
    nodes, functions = len(own[0]) // 3, barrier.functions
    scratch = soft.room(nodes, 1 << (count - 1).bit_length(), room)
    out, status = device.zeros(3 * nodes, count), wp.zeros(count, dtype=wp.int32, device=device.name)
    arrays = [from_view(device, x) for x in own] + [device.array(x) for x in asked]
    touching = barrier.stage(columns)
    kernel, model, ends = (
        build_kernel(device, functions),
        soft.model(columns, limits.rounded),
        allocate_ends(limits, room),
    )

    def part(first: int, stop: int) -> None:
        inputs = [*arrays, first, *touching, model, ends, scratch]
        launch(device, kernel, stop - first, inputs, [out, status])

    middle = count if device.on_cuda else (count + 1) // 2
    run_together([partial(part, 0, middle), partial(part, middle, count)])
    return view(out), status.numpy(), view(scratch.place)[:, :count]


def allocate_ends(limits: ForceLimits, room: int) -> Ends:
    """As the kernel takes them, with room for so many touched nodes."""
    ends = Ends()
    ends.iterations, ends.cuts, ends.late, ends.room = limits.iterations, limits.cuts, limits.late, room
    return ends


def allocate_scratch(device: Device, nodes: int, columns: int, room: int) -> Scratch:
    """For so many nodes, columns, and touched nodes."""

    def numbers(*shape: int) -> wp.array:
        return wp.empty(shape, dtype=wp.float64, device=device.name)

    def counts(*shape: int) -> wp.array:
        return wp.empty(shape, dtype=wp.int32, device=device.name)

    out, size = Scratch(), 3 * room
    for name in ("force", "w", "at", "slope", "change", "way", "held"):
        setattr(out, name, numbers(columns, 3 * nodes).transpose())
    out.place, out.acts = counts(columns, nodes).transpose(), counts(columns, nodes).transpose()
    out.touched, out.acting, out.counts = counts(columns, nodes), counts(columns, nodes), counts(columns, 2)
    out.learnt = numbers(columns, 2 * PAIRS, size)
    for name in ("soft", "stiff", "both", "system"):
        setattr(out, name, numbers(columns, size, size))
    out.x, out.y = numbers(columns, size), numbers(columns, size)
    return out

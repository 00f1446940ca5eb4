"""Contact forces: equilibrium of the few touched nodes; all other nodes follow by a quadratic model.

C (3n, 3n) is the compliance of the model at the touchable nodes, and w0 are positions without contact. w minimises

    (w - w0) . C^-1 (w - w0) / 2 + c(w) + d |w - v|^2 / 2 over touched nodes,

where c is the barrier energy of the tools, and d a proximal coefficient about the current positions v. Newton's method
solves for the tool forces f, with w = w0 - C f. The forces are zero except at touched nodes, so C is never inverted.
The input is the position under approximate forces, w1 = w0 - C f1, since differences from w1 have little round-off.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.term import ReducedBarrier
from ..linalg.compliance import Compliance
from ..minimisers.lbfgs_kernels import PAIRS
from ..runtime.blocks import launch
from ..runtime.device import Device
from ..runtime.threads import run_concurrently
from ..runtime.views import from_view, select_columns, to_host, to_view
from .contact_kernel import build_kernel
from .contact_structs import OPEN, SOLVED, TOO_MANY_TOUCHED, UNKNOWN, ComplianceModel, Limits, Scratch


@dataclass(frozen=True)
class ForceLimits:
    """Limits of Newton's method for the tool forces.

    Parameters
    ----------
    max_iterations, max_backtracks
        Maximum number of iterations, and of backtracking steps in one iteration.
    first_capacity, max_capacity
        Capacity of the first workspace and of the largest workspace [touched nodes].
    nonconvex_iterations
        Number of iterations after which a model that is still not convex is given up.
    diagonal_shift
        Diagonal shift of the compliance matrix, relative to its mean diagonal, which compensates round-off.
    max_bytes
        Maximum memory of the matrices of all load cases solved together [bytes].
    """

    max_iterations: int = 60
    max_backtracks: int = 20
    first_capacity: int = 64
    max_capacity: int = 300
    nonconvex_iterations: int = 12
    diagonal_shift: float = 1e-6
    max_bytes: int = 2**30


FORCES = ForceLimits()  # Default.
NONCONVEX = ForceLimits(nonconvex_iterations=FORCES.max_iterations)
"""Limits for models that may be nonconvex."""


@dataclass(frozen=True, eq=False)
class ContactCompliance:
    """Compliance C at n nodes: compliance of the undeformed mesh, plus updates for each of b load cases.

    `history` (b, 2m, 3n) and `middle_matrix` (b, 2m, 2m) in double precision are L-BFGS updates; None without history.
    `strain_change` (b, 3n, 3n) is the change by strained tissue, in float32. `get_scratch` allocates, or is cached.
    """

    undeformed: Compliance
    device: Device
    get_scratch: Callable[[int, int, int], Scratch]
    history: Any = None
    middle_matrix: Any = None
    strain_change: Any = None

    def ensure_columns(self, force: Any) -> None:
        """Compute missing columns of the undeformed compliance, for the nodes on which forces (3n, b) act."""
        every = self.undeformed.known.copy()
        if not every[: len(force) // 3].all():
            every[: len(force) // 3] = to_host((force != 0.0).any(1)).reshape(-1, 3).any(axis=1)
            self.undeformed.ensure_columns(every)

    def build_model(self, columns: np.ndarray, diagonal_shift: float) -> ComplianceModel:
        """Return the compliance of the load cases `columns` (k,) as a struct for kernels."""
        out, n, count = ComplianceModel(), len(self.undeformed.rows), len(columns)
        out.undeformed = from_view(self.device, self.undeformed.columns)
        out.has_columns = self.device.upload(self.undeformed.known, wp.int32)
        none = wp.zeros((count, 0, 0), dtype=wp.float32, device=self.device.name)
        matrix = self.device.allocate(count, 0, 0)
        kinds = ("history", self.device.allocate(count, 0, n)), ("middle_matrix", matrix), ("strain_change", none)
        for name, nothing in kinds:
            known = getattr(self, name)
            some = None if known is None else known[select_columns(self.device, columns, len(known))]
            setattr(out, name, nothing if some is None else from_view(self.device, some))
        out.diagonal_shift = diagonal_shift
        return out


def solve_contact_forces(
    barrier: ReducedBarrier,
    compliance: ContactCompliance,
    positions: Any,
    targets: Any,
    known_forces: Any,
    tolerance: np.ndarray,
    proximal: np.ndarray,
    limits: ForceLimits = FORCES,
) -> tuple[Any, np.ndarray]:
    """Return the tool forces f (3n, b) [N], and a mask (b,) of load cases that are solved.

    A load case fails if its model is not convex: the curvature of the tool exceeds the tissue stiffness, and the step
    would be far too long. `positions` (3n, b) [m] are the current positions v; `targets` are w1, `known_forces` are f1.
    `tolerance` (b,) is relative to the forces. `proximal` (b,) is d divided by the stiffness at a touched node.
    """
    out, status = known_forces + 0.0, np.full(positions.shape[1], OPEN)
    compliance.ensure_columns(known_forces)
    for room in (limits.first_capacity, limits.max_capacity):
        status[status == TOO_MANY_TOUCHED] = OPEN
        each = max(1, limits.max_bytes // (4 * 8 * (3 * room) ** 2))
        while (status == OPEN).any():
            some = np.flatnonzero(status == OPEN)[:each]
            on = select_columns(compliance.device, some, len(status))
            own = positions[:, on], targets[:, on], known_forces[:, on]
            asked = tolerance[some], proximal[some]
            force, status[some], touched = _solve_forces(barrier, compliance, some, own, asked, limits, room)
            ready = np.flatnonzero(status[some] == SOLVED)
            if len(ready):
                here_too = select_columns(compliance.device, ready, len(some))
                out[:, select_columns(compliance.device, some[ready], len(status))] = force[:, here_too]
            lacking = status[some] == UNKNOWN
            if lacking.any():
                compliance.ensure_columns((to_host(touched)[:, lacking] >= 0).repeat(3, axis=0))
                status[some[lacking]] = OPEN
    return out, status == SOLVED


def _solve_forces(
    barrier: ReducedBarrier,
    compliance: ContactCompliance,
    columns: np.ndarray,
    vectors: tuple[Any, Any, Any],
    constants: tuple[np.ndarray, np.ndarray],
    limits: ForceLimits,
    capacity: int,
) -> tuple[Any, np.ndarray, Any]:
    """Return forces (3n, k), status (k,) and node indices (n, k) of load cases, for up to `capacity` touched nodes.

    `vectors` are current positions, targets and known forces (3n, k); `constants` are tolerance and proximal (k,).
    """
    device, count = compliance.device, len(columns)
    nodes, functions = len(vectors[0]) // 3, barrier.functions
    scratch = compliance.get_scratch(nodes, 1 << (count - 1).bit_length(), capacity)
    out, status = device.allocate(3 * nodes, count), wp.zeros(count, dtype=wp.int32, device=device.name)
    arrays = [from_view(device, x) for x in vectors] + [device.upload(x) for x in constants]
    touching = barrier.build_structs(columns)
    kernel, model, ends = (
        build_kernel(device, functions),
        compliance.build_model(columns, limits.diagonal_shift),
        build_kernel_limits(limits, capacity),
    )

    def launch_part(first_case: int, stop: int) -> None:
        inputs = [*arrays, first_case, *touching, model, ends, scratch]
        launch(device, kernel, stop - first_case, inputs, [out, status])

    middle = count if device.on_cuda else (count + 1) // 2
    run_concurrently([partial(launch_part, 0, middle), partial(launch_part, middle, count)])
    return to_view(out), status.numpy(), to_view(scratch.touched_index)[:, :count]


def build_kernel_limits(limits: ForceLimits, capacity: int) -> Limits:
    """Return the limits as a struct for the kernel, with a capacity of `capacity` touched nodes."""
    ends = Limits()
    ends.max_iterations, ends.max_backtracks = limits.max_iterations, limits.max_backtracks
    ends.nonconvex_iterations, ends.capacity = limits.nonconvex_iterations, capacity
    return ends


def allocate_scratch(device: Device, nodes: int, columns: int, capacity: int) -> Scratch:
    """Return scratch arrays for the given numbers of nodes, load cases and touched nodes (`capacity`)."""

    def allocate_floats(*shape: int) -> wp.array:
        return wp.empty(shape, dtype=wp.float64, device=device.name)

    def allocate_ints(*shape: int) -> wp.array:
        return wp.empty(shape, dtype=wp.int32, device=device.name)

    out, size = Scratch(), 3 * capacity
    for name in ("force", "w", "trial", "gradient", "force_change", "direction", "proximal"):
        setattr(out, name, allocate_floats(columns, 3 * nodes).transpose())
    out.touched_index, out.acting_index = (allocate_ints(columns, nodes).transpose() for _ in range(2))
    out.touched_nodes, out.acting_nodes = allocate_ints(columns, nodes), allocate_ints(columns, nodes)
    out.counts = allocate_ints(columns, 2)
    out.middle_history = allocate_floats(columns, 2 * PAIRS, size)
    for name in ("compliance", "stiffness", "product", "system"):
        setattr(out, name, allocate_floats(columns, size, size))
    out.x, out.y = allocate_floats(columns, size), allocate_floats(columns, size)
    return out

"""One frame of a live tool on the device: footprint of a push, and L-BFGS from the state of the last frame.

All arrays are fixed, so that CUDA replays the frame as one captured graph. Only a few values are uploaded, and only the
result is downloaded; all other arrays, including the start, stay on the device.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ..discretisation.footprint import ContactSurface
from ..discretisation.inverted_elements import InversionCounter
from ..discretisation.problem import Problem
from ..linalg.pcg import Preconditioner
from ..local_solvers.strained_frame import UpdatedModel, UpdatedPreconditioner, compute_updated_model
from ..local_solvers.strained_part import StrainedPart
from ..minimisers.lbfgs_kernels import LIVE, PAIRS
from ..minimisers.lbfgs_state import LbfgsState, LbfgsWorkspace, allocate_memory, allocate_state
from ..runtime.columns import get_warp_width, sum_warp
from ..runtime.device import Device, forward_kernel

MAX_FRAME_EVALUATIONS = 60  # Maximum residual evaluations of a frame: a tool that moves smoothly needs fewer.
# Steps within which a frame must converge for its model of strained tissue to be kept: a new one costs twenty steps.
MAX_SERVED_STEPS = 12
INPUT_SIZE = 8  # Length of the input: point (3) and radius [m], force (3) [N], extrapolation factor.
# Slots of the output before the displacements; from SUMS on, the four sums of the footprint.
STATUS, STEPS, RESIDUAL, INVERTED, SUMS = 0, 1, 2, 3, 4
HEADER_SIZE = 8  # Number of these slots.


@dataclass(frozen=True)
class FrameKernels:
    """Kernels that run before, between and after the L-BFGS iterations of a frame, for one scalar type."""

    apply_push: wp.Kernel
    extrapolate: wp.Kernel
    reset: wp.Kernel
    check_ended: wp.Kernel
    write_results: wp.Kernel


@cache
def build_kernels(device: Device) -> FrameKernels:
    """Return the kernels for one load case, in the scalar type of a device."""
    scalar, most, m, head, lanes = device.scalar, MAX_FRAME_EVALUATIONS, PAIRS, HEADER_SIZE, get_warp_width(device)

    @forward_kernel(module="unique")
    def apply_push(
        inputs: wp.array(dtype=wp.float64),
        nodes: wp.array(dtype=wp.int32),
        weights: wp.array2d(dtype=wp.float64),
        sums: wp.array(dtype=wp.vec4d),
        # outputs
        constant: wp.array2d(dtype=scalar),
        constant_norms: wp.array2d(dtype=wp.float64),
    ):
        """Write the gradient -w_i / (sum of w) F of the push, and add its squared norm."""
        i = wp.tid()
        square = wp.float64(0.0)
        if i < nodes.shape[0]:
            share = weights[i, 0] / sums[0][0]
            for k in range(3):
                f = scalar(share * inputs[4 + k])
                constant[3 * nodes[i] + k, 0] = -f
                square += wp.float64(f) * wp.float64(f)
        square = sum_warp(square)
        if i % lanes == 0:
            wp.atomic_add(constant_norms, 0, 0, square)

    @forward_kernel(module="unique")
    def extrapolate(
        inputs: wp.array(dtype=wp.float64),
        # outputs
        last_u: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        d: wp.array2d(dtype=scalar),
        g: wp.array2d(dtype=scalar),
        z: wp.array2d(dtype=scalar),
    ):
        """Extrapolate u += a (u - past), store the old u in `last_u`, and clear direction and gradients."""
        r = wp.tid()
        last = u[r, 0]
        u[r, 0] = last + scalar(inputs[7]) * (last - last_u[r, 0])
        last_u[r, 0] = last
        d[r, 0] = scalar(0.0)
        g[r, 0] = scalar(0.0)
        z[r, 0] = scalar(0.0)

    @forward_kernel(module="unique")
    def reset(
        # outputs
        t: wp.array(dtype=wp.float64),
        predicted: wp.array(dtype=wp.float64),
        residual: wp.array(dtype=wp.float64),
        constant_norms: wp.array2d(dtype=wp.float64),
        sg: wp.array2d(dtype=wp.float64),
        wg: wp.array2d(dtype=wp.float64),
        steps: wp.array(dtype=wp.int32),
        backtracks: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        evaluations: wp.array(dtype=wp.int32),
        is_active: wp.array(dtype=wp.int32),
        inverted: wp.array(dtype=wp.int32),
    ):
        """Reset the iteration so that the start is evaluated first; the L-BFGS history does not change."""
        t[0] = wp.float64(0.0)
        predicted[0] = wp.float64(wp.inf)
        residual[0] = wp.float64(wp.inf)
        constant_norms[0, 0] = wp.float64(0.0)
        for i in range(m):
            sg[i, 0] = wp.float64(0.0)
            wg[i, 0] = wp.float64(0.0)
        steps[0] = 0
        backtracks[0] = 0
        status[0] = LIVE
        evaluations[0] = 0
        is_active[0] = 1
        inverted[0] = 0

    @forward_kernel(module="unique")
    def check_ended(
        status: wp.array(dtype=wp.int32),
        # outputs
        evaluations: wp.array(dtype=wp.int32),
        is_active: wp.array(dtype=wp.int32),
    ):
        """Increase the number of evaluations, and clear `is_active` if the descent has ended."""
        evaluations[0] = evaluations[0] + 1
        is_active[0] = wp.where(status[0] == LIVE and evaluations[0] < most, 1, 0)

    @forward_kernel(module="unique")
    def write_results(
        status: wp.array(dtype=wp.int32),
        steps: wp.array(dtype=wp.int32),
        residual: wp.array(dtype=wp.float64),
        inverted: wp.array(dtype=wp.int32),
        sums: wp.array(dtype=wp.vec4d),
        u: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Write status, counts, footprint sums and displacements to one array for the host."""
        r = wp.tid()
        out[head + r] = wp.float64(u[r, 0])
        if r == 0:
            out[STATUS] = wp.float64(status[0])
            out[STEPS] = wp.float64(steps[0])
            out[RESIDUAL] = residual[0]
            out[INVERTED] = wp.float64(inverted[0])
            for k in range(4):
                out[SUMS + k] = sums[0][k]

    return FrameKernels(apply_push, extrapolate, reset, check_ended, write_results)


class CapturedFrame:
    """Solver of one push that starts from the state on the device and replaces this state by the solution.

    Parameters
    ----------
    problem, preconditioner
        Problem with pushes as the only loads, and a preconditioner that does not depend on the state.
    inversion
        Counter of inverted elements for the same discretisation.
    skin
        Surface on which tools push.
    tolerance
        Tolerance of the relative residual, as in `Accuracy`.
    part
        Object that finds strained tissue, for updates of the preconditioner; None: no updates.
    """

    def __init__(
        self,
        problem: Problem,
        preconditioner: Preconditioner,
        inversion: InversionCounter,
        skin: ContactSurface,
        tolerance: float,
        part: StrainedPart | None = None,
    ):
        self._device, self._inversion, self._skin, self.part = problem.device, inversion, skin, part
        self.bent: UpdatedModel | None = None
        """Model of strained tissue for the next frame."""
        self._knowing: UpdatedPreconditioner | None = None
        if part is not None:
            part.prepare()
            self._knowing = UpdatedPreconditioner(preconditioner, problem, part.size)
        self._workspace = LbfgsWorkspace(problem, self._knowing or preconditioner, 1, allocate_memory(problem, 1))
        self._workspace.columns["tolerance"].fill_(tolerance)
        self._workspace.prepare()
        self._before = allocate_state(problem, 1, allocate_memory(problem, 1))
        self._past = problem.device.allocate(problem.rows, 1)
        name = problem.device.name
        self._tried, self._going, self._inverted = (wp.zeros(1, dtype=wp.int32, device=name) for _ in range(3))
        self._given, self._up = self._allocate_transfer(INPUT_SIZE)
        self._out, self._down = self._allocate_transfer(HEADER_SIZE + problem.rows)
        self._imprint = skin.allocate_footprints(wp.array(ptr=self._given.ptr, dtype=wp.vec4d, shape=(1,), device=name))
        self._graph: wp.Graph | None = None

    @property
    def state(self) -> LbfgsState:
        """State of the last solution."""
        return self._workspace.state

    @property
    def u(self) -> wp.array:
        """Displacements (3N, 1) [m] of the last solution."""
        return self._workspace.columns["u"]

    @property
    def previous_state(self) -> LbfgsState:
        """State from which the last solution started."""
        return self._before

    def load_state(
        self,
        u: np.ndarray,
        last_u: np.ndarray | None,
        history: Mapping[str, np.ndarray],
        model: UpdatedModel | None = None,
    ) -> None:
        """Load another state: displacements u (3N, 1) [m], previous displacements and, if any, the L-BFGS history."""
        columns = self._workspace.columns
        self._load_updated_model(model)
        columns["u"].assign(u)
        self._past.assign(u if last_u is None else last_u)
        for name in ("s", "w", "known"):
            columns[name].zero_()
        columns["head"].fill_(PAIRS - 1)
        for name, rows_first in history.items():
            columns[name].assign(np.moveaxis(rows_first, 0, -1).reshape(columns[name].shape))

    def update_model(self, steps: float) -> None:
        """Recompute the model of strained tissue if the last solution took more than `MAX_SERVED_STEPS` steps."""
        if self.part is not None and steps > MAX_SERVED_STEPS:
            self._load_updated_model(compute_updated_model(self.part, self._device, self._workspace.columns["u"]))
            self._workspace.columns["known"].zero_()  # curvature pairs are valid for their own model only

    def _load_updated_model(self, model: UpdatedModel | None) -> None:
        if self._knowing is not None:
            self.bent = model
            self._knowing.load_model(model)

    def solve_push(self, point: np.ndarray, radius: float, force: np.ndarray, extrapolation: float) -> np.ndarray:
        """Return the result of a push at `point` (3,) [m] with a footprint `radius` [m] and a `force` (3,) [N].

        The result (HEADER_SIZE + 3N,) has a header, and then the displacements.

        The start is the current state plus `extrapolation` times its change since the previous state. The next frame
        overwrites the returned array.
        """
        self._up.numpy()[:] = (*point, radius, *force, extrapolation)
        device = self._device
        if self._graph is not None:
            wp.capture_launch(self._graph)
        else:
            self._launch_frame()
        if device.on_cuda:
            wp.synchronize_stream(wp.get_stream(device.name))
            # Modules that a capture cannot load are loaded once a step has been taken.
            if self._graph is None and self._down.numpy()[STEPS] > 0:
                with wp.ScopedCapture(device.name, force_module_load=False) as capture:
                    self._launch_frame()
                self._graph = capture.graph
        return self._down.numpy()

    def _launch_frame(self) -> None:
        a, k, device, imprint = self._workspace.columns, build_kernels(self._device), self._device, self._imprint
        wp.copy(self._given, self._up)
        for kind, array in self._before.movable.items():
            wp.copy(array, self._workspace.state.movable[kind])
        self._skin.compute_footprints(imprint)
        names = ("t", "predicted", "residual", "loud", "sg", "wg", "steps", "cut", "status")
        outputs = [*(a[name] for name in names), self._tried, self._going, self._inverted]
        device.launch(k.reset, (1,), [], outputs)
        vectors = [self._past, *(a[name] for name in ("u", "d", "g", "z"))]
        device.launch(k.extrapolate, (len(self._past),), [self._given], vectors)
        inputs = [self._given, self._skin.numbers, imprint.weight, imprint.sums]
        lanes = get_warp_width(device)
        device.launch(k.apply_push, (-(-len(self._skin.numbers) // lanes) * lanes,), inputs, [a["constant"], a["loud"]])
        wp.capture_while(self._going, self._iterate)
        self._inversion.add_count(a["u"], self._inverted)
        inputs = [a["status"], a["steps"], a["residual"], self._inverted, imprint.sums, a["u"]]
        device.launch(k.write_results, (len(self._past),), inputs, [self._out])
        wp.copy(self._down, self._out)

    def _iterate(self) -> None:
        self._workspace.run_iteration()
        inputs = [self._workspace.columns["status"]]
        self._device.launch(build_kernels(self._device).check_ended, (1,), inputs, [self._tried, self._going])

    def _allocate_transfer(self, count: int) -> tuple[wp.array, wp.array]:
        """Return arrays of `count` values on the device, and in pinned host memory for direct transfer."""
        there = wp.zeros(count, dtype=wp.float64, device=self._device.name)
        return there, wp.zeros(count, dtype=wp.float64, device="cpu", pinned=self._device.on_cuda)

"""Contact steps of single load cases with fixed arrays, which CUDA replays as captured graphs.

The steps are those of `contact_descent.py`, which makes all decisions between them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.term import LocalBarrier
from ..linalg.compliance import Compliance
from ..linalg.pcg import Preconditioner
from ..minimisers.lbfgs_kernels import FREE, WHOLE
from ..minimisers.residual import allocate_residual_arrays, compute_residual_arrays
from ..runtime import blocks
from ..runtime.columns import add_dots, combine_columns, put_rows, take_rows
from ..runtime.columns import build_kernels as columns_kernels_of
from ..runtime.device import Device, forward_kernel
from ..runtime.views import from_view, to_view
from .contact_batch import ContactState
from .contact_forces import FORCES, NONCONVEX, allocate_scratch, build_kernel_limits
from .contact_kernel import build_kernel
from .contact_structs import ComplianceModel, Limits
from .press_kernel import build_gemv_kernel
from .strained_part import StrainedModel

# Threads that share one row of a matrix product.
ROW_THREADS = 16
# Slots of the input: tolerance of the tools' forces, proximal coefficient, length of a shortened step; their number.
TOLERANCE, DRAG, LENGTH, INPUT_SIZE = 0, 1, 2, 3
# Slots of the output: status, step length, predicted decrease, slope, largest square norm, sums; their number.
STATUS, TRIED_LENGTH, PREDICTED_DECREASE, TRIAL_SLOPE, MAX_SQUARE_NORM, WHOLE_SUM, FREE_SUM, OUTPUT_SIZE = range(8)


@dataclass(frozen=True)
class ContactStepKernels:
    """Kernels that run between the matrix products of a step, for one scalar type."""

    compute_positions: wp.Kernel
    compute_change: wp.Kernel
    read_length: wp.Kernel
    add_forces: wp.Kernel
    write_results: wp.Kernel


@cache
def build_kernels(device: Device) -> ContactStepKernels:
    """Return the kernels for one load case, in the scalar type of a device."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def compute_positions(
        rows: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        response: wp.array2d(dtype=scalar),
        correction: wp.array2d(dtype=scalar),
        # outputs
        positions: wp.array2d(dtype=wp.float64),
        targets: wp.array2d(dtype=wp.float64),
    ):
        """Compute the current positions of the nodes, and their positions under the known forces."""
        i = wp.tid()
        positions[i, 0] = wp.float64(u[rows[i], 0])
        targets[i, 0] = positions[i, 0] - wp.float64(response[rows[i], 0]) - wp.float64(correction[i, 0])

    @forward_kernel(module="unique")
    def compute_change(
        new_force: wp.array2d(dtype=wp.float64),
        force: wp.array2d(dtype=wp.float64),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute the change of the tool forces."""
        i = wp.tid()
        out[i, 0] = scalar(new_force[i, 0] - force[i, 0])

    @forward_kernel(module="unique")
    def read_length(
        inputs: wp.array(dtype=wp.float64),
        # outputs
        length: wp.array(dtype=scalar),
    ):
        """Read the step length from the input."""
        length[0] = scalar(inputs[LENGTH])

    @forward_kernel(module="unique")
    def add_forces(
        rows: wp.array(dtype=wp.int32),
        force: wp.array2d(dtype=wp.float64),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the forces to selected rows: out_rows(i) += f_i."""
        i = wp.tid()
        out[rows[i], 0] += scalar(force[i, 0])

    @forward_kernel(module="unique")
    def write_results(
        status: wp.array(dtype=wp.int32),
        length: wp.array(dtype=scalar),
        predicted: wp.array(dtype=wp.float64),
        trial_slope: wp.array(dtype=wp.float64),
        sums: wp.array2d(dtype=wp.float64),
        term_norms: wp.array2d(dtype=wp.float64),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Write all results for the host to one array."""
        out[STATUS] = wp.float64(status[0])
        out[TRIED_LENGTH] = wp.float64(length[0])
        out[PREDICTED_DECREASE] = -predicted[0]
        out[TRIAL_SLOPE] = trial_slope[0]
        loudest = wp.float64(0.0)
        for i in range(term_norms.shape[0]):
            loudest = wp.where(term_norms[i, 0] <= loudest, loudest, term_norms[i, 0])
        out[MAX_SQUARE_NORM] = loudest
        out[WHOLE_SUM] = sums[WHOLE, 0]
        out[FREE_SUM] = sums[FREE, 0]

    return ContactStepKernels(compute_positions, compute_change, read_length, add_forces, write_results)


def read_step_result(output: np.ndarray, norms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return length, slope at its end [J], residual [N] and residual scale [N] of a step, (1,) each, from the output.

    `output` is from `ContactSteps`; `norms` (1,) is `ResidualEvaluator.square`.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        free = np.sqrt(output[[FREE_SUM]])
        scale = np.sqrt(np.maximum(np.maximum(norms, output[MAX_SQUARE_NORM]), output[[WHOLE_SUM]] - output[FREE_SUM]))
    ahead = np.where(np.isfinite(free) & np.isfinite(scale), output[[TRIAL_SLOPE]], np.inf)
    return output[[TRIED_LENGTH]], ahead, free, scale


class ContactSteps:
    """Contact steps of one load case with fixed arrays. The views from `load_state` may be changed between steps.

    Parameters
    ----------
    problem, preconditioner
        See `ContactDescent`.
    barrier
        Tool barrier of the problem.
    compliance
        Compliance at the touchable nodes, with all columns computed, and then at other nodes.
    size
        Number of rows 3k of the largest model of strained tissue.
    """

    def __init__(
        self, problem: Problem, preconditioner: Preconditioner, barrier: LocalBarrier, compliance: Compliance, size: int
    ):
        device = problem.device
        name, exact, count = device.name, replace(device, precision="float64"), 3 * len(barrier.touchable_nodes)
        self._problem, self._preconditioner, self._barrier, self._device = problem, preconditioner, barrier, device

        def allocate_column(rows: int) -> wp.array:
            return device.allocate(rows, 1)

        self._u, self._smooth, self._whole, self._rest, self._x = (allocate_column(problem.rows) for _ in range(5))
        self._new_u, self._new_smooth, self._new_rest = (allocate_column(problem.rows) for _ in range(3))
        self._constant, self._pull, self._answer, self._pressed = (allocate_column(problem.rows) for _ in range(4))
        self._force, self._found, self._here, self._there = (exact.allocate(count, 1) for _ in range(4))
        self._balance = allocate_residual_arrays(problem, 1)
        self._near, self._own, self._more, self._change = (allocate_column(len(compliance.rows)) for _ in range(4))
        self._rows = device.upload(compliance.rows, wp.int32)
        self._touched = self._rows[:count]
        self._nodes = wp.zeros((1, size // 3), dtype=wp.int32, device=name)
        self._matrix = wp.zeros((1, size, size), dtype=wp.float64, device=name)
        self._compliance = from_view(exact, compliance.columns).reshape((1, *compliance.columns.shape))
        self._every = device.upload(np.arange(len(compliance.nodes))[None], wp.int32)
        self._model = ComplianceModel()
        self._model.undeformed, self._model.has_columns = self._compliance[0], device.upload(compliance.known, wp.int32)
        self._model.history = exact.allocate(1, 0, len(compliance.rows))
        self._model.middle_matrix = exact.allocate(1, 0, 0)
        self._model.strain_change = wp.zeros((1, count + 1, count + 1), dtype=wp.float32, device=name)
        self._model.diagonal_shift = FORCES.diagonal_shift
        self._scratch = allocate_scratch(exact, count // 3, 1, FORCES.first_capacity)
        self._exact, self._touch = exact, None
        self._status = wp.zeros(1, dtype=wp.int32, device=name)
        self._length = wp.zeros(1, dtype=device.scalar, device=name)
        self._promised, self._ahead = (wp.zeros(1, dtype=wp.float64, device=name) for _ in range(2))
        self._given, self._up = self._allocate_transfer(INPUT_SIZE)
        self._out, self._down = self._allocate_transfer(OUTPUT_SIZE)
        self._live = np.ones(1, bool)
        self._graphs: dict[str, wp.Graph] = {}

    def load_model(self, model: StrainedModel) -> None:
        """Copy a model of strained tissue for one load case to the fixed arrays."""
        for array in (self._nodes, self._matrix, self._model.strain_change):
            array.zero_()
        if model.has_strained_nodes:
            count = model.nodes.shape[1]
            to_view(self._nodes)[:, :count] = model.nodes
            to_view(self._matrix)[:, : 3 * count, : 3 * count] = model.matrix
            to_view(self._model.strain_change)[:] = model.change

    def compute_direction(self, tolerance: float, proximal: float, allow_nonconvex: bool = False) -> np.ndarray:
        """Solve for tool forces with a proximal term, direction and longest step; return results (`OUTPUT_SIZE`,).

        If `allow_nonconvex`, the model may be nonconvex. If the status is not `SOLVED`, the other results are invalid.
        The next call overwrites the returned array.
        """
        self._up.numpy()[[TOLERANCE, DRAG]] = tolerance, proximal
        ends = build_kernel_limits(NONCONVEX if allow_nonconvex else FORCES, FORCES.first_capacity)
        return self._run_graph("bent" if allow_nonconvex else "aim", lambda: self._compute_direction(ends))

    def shorten_step(self, length: float) -> np.ndarray:
        """Evaluate a step with a shorter `length`, and return its results (`OUTPUT_SIZE`,)."""
        self._up.numpy()[LENGTH] = length
        return self._run_graph("again", self._retry_shorter_step)

    def take_step(self) -> None:
        """Accept the last trial step: its state becomes the current state."""
        self._run_graph("accept", self._take_step)

    def load_tools(self, constant_gradient: wp.array) -> bool:
        """Load tool poses from the problem, and constant gradients (3N, 1) [N]; return False if there are no tools."""
        reduction = self._barrier.reduce(np.zeros(1, int))
        if reduction is None:
            return False
        if self._touch is None:
            self._touch = build_kernel(self._exact, reduction.functions), reduction.build_structs(np.zeros(1, int))
        wp.copy(self._constant, constant_gradient)
        return True

    def load_state(self, state: ContactState, force: Any, response: Any) -> tuple[ContactState, Any, Any, Any]:
        """Load a state, forces and linear response; return views of these arrays, and of the direction."""
        here = [to_view(array) for array in (self._u, self._smooth, self._whole, self._force, self._rest, self._x)]
        for mine, its in zip(here, (state.u, state.smooth_gradient, state.gradient, force, response), strict=False):
            mine[:] = its
        u, smooth, whole, *others = here
        return ContactState(u, smooth, whole, state.norm.copy(), state.scale.copy()), *others

    def _run_graph(self, name: str, function: Callable[[], None]) -> np.ndarray:
        device = self._device
        if name in self._graphs:
            wp.capture_launch(self._graphs[name])
        else:
            function()
        if device.on_cuda:
            wp.synchronize_stream(wp.get_stream(device.name))
            if name not in self._graphs:
                with wp.ScopedCapture(device.name, force_module_load=False) as capture:
                    function()
                self._graphs[name] = capture.graph
        return self._down.numpy()

    def _compute_direction(self, kernel_limits: Limits) -> None:
        device, k = self._device, build_kernels(self._device)
        assert self._touch is not None
        kernel, stage = self._touch
        wp.copy(self._given, self._up)
        take_rows(device, self._rest, self._rows, self._near)
        self._apply_strained_stiffness()
        self._more.zero_()
        self._add_motion(self._own, self._more, len(self._touched))
        inputs = [self._touched, self._u, self._rest, self._more]
        device.launch(k.compute_positions, (len(self._touched),), inputs, [self._here, self._there])
        self._status.zero_()
        self._found.zero_()
        given = [self._given[TOLERANCE : TOLERANCE + 1], self._given[DRAG : DRAG + 1], 0]
        inputs = [self._here, self._there, self._force, *given, *stage, self._model, kernel_limits, self._scratch]
        blocks.launch(self._exact, kernel, 1, inputs, [self._found, self._status])
        self._change.zero_()
        device.launch(k.compute_change, (len(self._touched),), [self._found, self._force], [self._change])
        self._add_motion(self._change, self._near, len(self._rows))
        self._apply_strained_stiffness()
        combine_columns(device, self._own, 1.0, self._change, self._own)
        self._pull.zero_()
        put_rows(device, self._own, self._rows, self._pull)
        self._compute_response(self._answer)
        combine_columns(device, self._answer, 1.0, self._rest, self._x)
        combine_columns(device, self._x, -2.0, self._x, self._x)
        self._length.fill_(1.0)
        for term in self._problem.terms:
            term.longest_step(self._u, self._x, self._length)
        self._promised.zero_()
        add_dots(device, self._whole, self._x, self._promised)
        self._evaluate_trial()

    def _retry_shorter_step(self) -> None:
        wp.copy(self._given, self._up)
        self._device.launch(build_kernels(self._device).read_length, (1,), [self._given], [self._length])
        self._evaluate_trial()

    def _evaluate_trial(self) -> None:
        """Evaluate the trial step: the residual there, and the linear response to this residual."""
        device, problem, k = self._device, self._problem, build_kernels(self._device)
        inputs = [self._u, self._length, self._x]
        device.launch(columns_kernels_of(device).combine, self._u.shape, inputs, [self._new_u])
        found = compute_residual_arrays(problem, self._new_u, self._constant, self._x, self._balance)
        self._pressed.zero_()
        self._barrier.add_gradient(self._new_u, self._pressed)
        problem.constraint.project_nodes(self._pressed)
        combine_columns(device, found.g, -1.0, self._pressed, self._new_smooth)
        self._ahead.zero_()
        add_dots(device, found.g, self._x, self._ahead)
        wp.copy(self._pull, self._new_smooth)
        device.launch(k.add_forces, (len(self._touched),), [self._touched, self._found], [self._pull])
        self._compute_response(self._new_rest)
        inputs = [self._status, self._length, self._promised, self._ahead, found.sums, found.term_norms]
        device.launch(k.write_results, (1,), inputs, [self._out])
        wp.copy(self._down, self._out)

    def _take_step(self) -> None:
        for to, new in (
            (self._u, self._new_u),
            (self._smooth, self._new_smooth),
            (self._whole, self._balance.g),
            (self._rest, self._new_rest),
            (self._force, self._found),
        ):
            wp.copy(to, new)

    def _apply_strained_stiffness(self) -> None:
        """Multiply the motions of strained nodes by the matrix of the strained tissue model."""
        self._own.zero_()
        inputs = [self._matrix, self._nodes, self._near]
        dim = (ROW_THREADS, 1, self._matrix.shape[2])
        self._device.launch(
            build_gemv_kernel(self._device, wp.float64, wp.float64, ROW_THREADS), dim, inputs, [self._own]
        )

    def _add_motion(self, force: wp.array, out: wp.array, rows: int) -> None:
        """Add the motion of the undeformed mesh under `force` to the first `rows` of `out`."""
        inputs = [self._compliance, self._every, force]
        self._device.launch(
            build_gemv_kernel(self._device, wp.float64, wp.float64, ROW_THREADS), (ROW_THREADS, 1, rows), inputs, [out]
        )

    def _compute_response(self, out: wp.array) -> None:
        """Compute the linear response of the undeformed mesh to the forces in `_pull`."""
        self._problem.constraint.project_nodes(self._pull)
        self._preconditioner.apply(self._pull, self._live, out)
        self._problem.constraint.project_nodes(out)

    def _allocate_transfer(self, count: int) -> tuple[wp.array, wp.array]:
        """Return arrays of `count` values on the device, and in pinned host memory for direct transfer."""
        there = wp.zeros(count, dtype=wp.float64, device=self._device.name)
        return there, wp.zeros(count, dtype=wp.float64, device="cpu", pinned=self._device.on_cuda)

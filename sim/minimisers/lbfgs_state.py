"""State of the load cases of a batch between L-BFGS iterations, and the iteration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..linalg.pcg import Preconditioner
from ..runtime.columns import add_dots, combine_columns, gather_columns
from . import lbfgs_trial_kernels
from .lbfgs_kernels import DONE, PAIRS, PRODUCTS, ROWS_PER_THREAD, SUMS, build_kernels, get_rows_per_thread
from .lbfgs_trial_kernels import build_multiply_kernel
from .residual import ResidualArrays, compute_constant_gradients, compute_residual_arrays

Shapes = Mapping[str, tuple[int, ...]]  # Array shapes by name, without the axis of load cases.


def describe_layout(problem: Problem) -> dict[str, tuple[Any, Shapes, Shapes]]:
    """Return by number type: dtype, shapes of arrays that move with load cases, shapes of recomputed arrays."""
    vector, pairs, terms = (problem.rows,), (PAIRS, problem.rows), (len(problem.terms),)
    return {
        "scalar": (
            problem.device.scalar,
            {**dict.fromkeys(("u", "d", "g", "z", "constant"), vector), "s": pairs, "w": pairs},
            {
                **dict.fromkeys(("v", "new_z", "new_g", "part"), vector),
                **dict.fromkeys(("along_s", "along_w"), (PAIRS,)),
                "bound": (),
            },
        ),
        "double": (
            wp.float64,
            {
                **dict.fromkeys(("t", "predicted", "residual", "tolerance", "force"), ()),
                **dict.fromkeys(("sg", "wg"), (PAIRS,)),
                **dict.fromkeys(("sy", "yw"), (PAIRS, PAIRS)),
                "loud": terms,
            },
            {"products": (2 * PAIRS + PRODUCTS,), "step_length": (), "sums": (SUMS,), "own": terms},
        ),
        "whole": (
            wp.int32,
            dict.fromkeys(("steps", "cut", "known", "status", "head"), ()),
            dict.fromkeys(("accepted", "slot", "aiming"), ()),
        ),
    }


def allocate_memory(problem: Problem, width: int) -> dict[str, wp.array]:
    """Return memory, by number type, shared by workspaces of at most this width, of which one is in use at a time."""
    return {
        kind: wp.zeros((_count_values(moved) + _count_values(written), width), dtype=dtype, device=problem.device.name)
        for kind, (dtype, moved, written) in describe_layout(problem).items()
    }


@dataclass(frozen=True, eq=False)
class LbfgsState:
    """L-BFGS arrays of `width` load cases, by name; arrays that move with load cases, by number type; memory."""

    columns: Mapping[str, wp.array]
    movable: Mapping[str, wp.array]
    memory: Mapping[str, wp.array]  # kept alive here: its views hold no reference


def allocate_state(problem: Problem, width: int, memory: Mapping[str, wp.array]) -> LbfgsState:
    """Return the state of `width` load cases in `memory`, allocated by `allocate_memory` for at least this width."""
    columns: dict[str, wp.array] = {}
    together: dict[str, wp.array] = {}
    for kind, (_, moved, written) in describe_layout(problem).items():
        first = 0
        for name, shape in {**moved, **written}.items():
            columns[name] = _view_memory(memory[kind], first, (*shape, width))
            first += width * prod(shape)
        together[kind] = _view_memory(memory[kind], 0, (_count_values(moved), width))
    return LbfgsState(columns, together, memory)


class LbfgsWorkspace:
    """Workspace of L-BFGS in shared memory; load cases are the last axis. A GPU captures the iteration as a graph.

    Parameters
    ----------
    problem, preconditioner
        Problem to solve, and its preconditioner.
    width
        Maximum number of load cases.
    memory
        Memory from `allocate_memory` for at least this width.
    """

    def __init__(self, problem: Problem, preconditioner: Preconditioner, width: int, memory: Mapping[str, wp.array]):
        self.width = width
        self._problem = problem
        self._preconditioner = preconditioner
        self._kernels = build_kernels(problem.device, PAIRS)
        self._graph: wp.Graph | None = None
        self.state = allocate_state(problem, width, memory)
        self.columns = a = self.state.columns
        self._trial = ResidualArrays(a["new_g"], a["part"], a["sums"], a["own"])

    def begin(
        self, start: wp.array, tolerance: np.ndarray, force_tolerance: np.ndarray, history: Mapping[str, np.ndarray]
    ) -> None:
        """Load a batch of at most `width` load cases; the first iteration evaluates the start (3N, b) [m]."""
        a, device, spare = self.columns, self._problem.device, self.width - start.shape[1]
        for array in (a["d"], a["g"], a["z"], self.state.movable["double"], self.state.movable["whole"]):
            array.zero_()
        if spare:
            index = self._pad_indices(np.arange(start.shape[1]))
            self._problem.keep(index)
            gather_columns(device, start, index, a["u"])
        else:
            wp.copy(a["u"], start)
        for name, value in (("predicted", np.inf), ("residual", np.inf), ("head", PAIRS - 1)):
            a[name].fill_(value)
        # Load cases that only fill the workspace converge at once.
        a["tolerance"].assign(np.append(tolerance, np.full(spare, np.inf)))
        a["force"].assign(np.append(force_tolerance, np.full(spare, np.inf)))
        constant, loud = compute_constant_gradients(self._problem, a["u"])
        wp.copy(a["constant"], constant)
        wp.copy(a["loud"], loud)
        for name, rows_first in history.items():
            a[name].assign(np.moveaxis(rows_first, 0, -1).reshape(a[name].shape))
        self.prepare()

    def set_direction(self, g: wp.array, z: wp.array) -> None:
        """Set the first direction to -z (3N, b), for a start with residual g (3N, b)."""
        a, device, count = self.columns, self._problem.device, g.shape[1]
        index = device.upload(self._pad_indices(np.arange(count)), wp.int32)
        gather_columns(device, g, index, a["g"])
        gather_columns(device, z, index, a["z"])
        combine_columns(device, a["d"], -1.0, a["z"], a["d"])
        a["predicted"].zero_()
        add_dots(device, a["g"], a["z"], a["predicted"])
        a["t"].fill_(1.0)
        self._limit_steps()

    def take_columns(self, source: LbfgsWorkspace, columns: np.ndarray) -> None:
        """Load the state of the load cases `columns` (k,) of another workspace, to continue these cases."""
        index = self._pad_indices(columns)
        self._problem.keep(index)
        there = self._problem.device.upload(index, wp.int32)
        for kind, own in self.state.movable.items():
            wp.copy(own, gather_columns(self._problem.device, source.state.movable[kind], there))
        if len(columns) < self.width:
            self.columns["status"][len(columns) :].fill_(DONE)
        self.prepare()

    def _pad_indices(self, columns: np.ndarray) -> np.ndarray:
        """Return the indices padded to the width of the workspace by repeating the last index."""
        return np.append(columns, np.full(self.width - len(columns), columns[-1]))

    def prepare(self) -> None:
        """Clear temporary arrays, and prepare a preconditioner that runs on the host for the current batch."""
        self.columns["part"].zero_()
        self.columns["bound"].fill_(1.0)
        if self._preconditioner.on_device:
            return
        u = self.columns["u"]
        self._problem.linearise(u, np.zeros(u.shape[1], bool))
        self._preconditioner.prepare(self._problem, u.shape[1])

    def iterate(self, count: int) -> None:
        """Run `count` L-BFGS iterations."""
        device = self._problem.device
        if not (device.on_cuda and self._preconditioner.on_device):
            for _ in range(count):
                self.run_iteration()
            return
        if self._graph is None:
            self.run_iteration()  # loads modules, which a capture cannot
            if not self.columns["aiming"].numpy().any():
                self._compute_directions()  # loads those that no load case has used
            with wp.ScopedCapture(device.name, force_module_load=False) as capture:
                self.run_iteration()
            self._graph = capture.graph
            count -= 1
        for _ in range(count):
            wp.capture_launch(self._graph)

    def run_iteration(self) -> None:
        """Run one iteration; a GPU captures the iteration as a graph unless the preconditioner runs on the host."""
        a, k = self.columns, self._kernels
        problem, device = self._problem, self._problem.device
        rows, count = a["u"].shape
        spread, one = lbfgs_trial_kernels.choose_thread_spread(device, count), (count,)
        step = lbfgs_trial_kernels.build_kernels(device, spread).compute_trial
        device.launch(step, (spread.count_threads(rows), count), [a["u"], a["t"], a["d"]], [a["v"]])
        found = compute_residual_arrays(problem, a["v"], a["constant"], a["d"], self._trial)
        inputs = [a["loud"], found.term_norms, a["tolerance"], a["force"], found.sums, a["predicted"]]
        names = ("status", "accepted", "steps", "cut", "t", "step_length", "residual", "slot", "aiming")
        device.launch(k.check_step, one, inputs, [a[name] for name in names])
        if count == 1 and (not device.on_cuda or wp.is_conditional_graph_supported()):
            wp.capture_if(a["aiming"], self._compute_directions)
        else:
            self._compute_directions()
        inputs = [a["status"], a["accepted"], a["known"], a["slot"], a["step_length"], a["along_s"], a["along_w"]]
        outputs = [a["u"], a["d"], a["g"], a["z"], a["s"], a["w"]]
        device.launch(
            k.accept_step, (-(-rows // get_rows_per_thread(device)), count), [*inputs, found.g, a["new_z"]], outputs
        )
        self._limit_steps()

    def _compute_directions(self) -> None:
        """Compute the next direction, from the new gradient, of each load case with an accepted step."""
        a, k = self.columns, self._kernels
        problem, device, g = self._problem, self._problem.device, self._trial.g
        rows, count = a["u"].shape
        live = np.ones(count, bool)
        if not self._preconditioner.on_device:  # the host skips load cases that backtrack
            live = a["aiming"].numpy() != 0
        if live.any():
            self._preconditioner.apply(g, live, a["new_z"])
        problem.constraint.project_nodes(a["new_z"])
        a["products"].zero_()
        inputs, outputs = [a["known"], a["s"], a["w"], a["g"], a["z"], g, a["new_z"]], [a["products"]]
        if count == 1 and device.on_cuda:
            dim = (len(a["products"]), lbfgs_trial_kernels.choose_thread_spread(device, 1).count_threads(rows))
            device.launch(build_multiply_kernel(device, PAIRS), dim, inputs, outputs)
        else:
            device.launch(k.compute_products, (-(-rows // ROWS_PER_THREAD), count), inputs, outputs)
        inputs = [a["aiming"], a["step_length"], self._trial.sums, a["products"]]
        outputs = [a["status"], a["head"], a["known"], a["slot"], a["t"], a["predicted"]]
        outputs += [a["sg"], a["wg"], a["sy"], a["yw"], a["along_s"], a["along_w"]]
        device.launch(k.set_direction, (count,), inputs, outputs)

    def _limit_steps(self) -> None:
        a, bound = self.columns, self.columns["bound"]
        for term in self._problem.terms:
            term.longest_step(a["u"], a["d"], bound)
        self._problem.device.launch(self._kernels.limit_step, (self.width,), [], [bound, a["t"]])


def _view_memory(memory: wp.array, first: int, shape: tuple[int, ...]) -> wp.array:
    """Return a view of memory from element `first` with a `shape`; Warp slices cannot skip 2^31 elements."""
    address = memory.ptr + first * wp.types.type_size_in_bytes(memory.dtype)
    return wp.array(ptr=address, dtype=memory.dtype, shape=shape, device=memory.device)


def _count_values(shapes: Shapes) -> int:
    return sum(prod(shape) for shape in shapes.values())

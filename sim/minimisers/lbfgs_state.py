"""Everything that the columns of a batch carry from turn to turn of L-BFGS, and the turn itself."""

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
from .lbfgs_kernels import DONE, PAIRS, PRODUCTS, SOME, SUMS, build_kernels, get_rows_per_thread
from .lbfgs_trial_kernels import multiply_of
from .residual import Balance, compute_balance, compute_constant_gradients

Shapes = Mapping[str, tuple[int, ...]]


def describe_layout(problem: Problem) -> dict[str, tuple[Any, Shapes, Shapes]]:
    """By kind of number: its type, the arrays that move with their columns, and those that a turn writes anew."""
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
                **dict.fromkeys(("t", "promised", "residual", "tolerance", "force"), ()),
                **dict.fromkeys(("sg", "wg"), (PAIRS,)),
                **dict.fromkeys(("sy", "yw"), (PAIRS, PAIRS)),
                "loud": terms,
            },
            {"products": (2 * PAIRS + PRODUCTS,), "gone": (), "sums": (SUMS,), "own": terms},
        ),
        "whole": (
            wp.int32,
            dict.fromkeys(("steps", "cut", "known", "status", "head"), ()),
            dict.fromkeys(("accepted", "slot", "aiming"), ()),
        ),
    }


def allocate_ground(problem: Problem, width: int) -> dict[str, wp.array]:
    """Memory, by kind of number, for rooms of at most this width: they stand in the same place, one at a time."""
    return {
        kind: wp.zeros((_rows(moved) + _rows(written), width), dtype=dtype, device=problem.device.name)
        for kind, (dtype, moved, written) in describe_layout(problem).items()
    }


@dataclass(frozen=True, eq=False)
class LbfgsState:
    """Arrays of `width` columns by name, and by kind of number all those that move with them, where both stand."""

    columns: Mapping[str, wp.array]
    moved: Mapping[str, wp.array]
    ground: Mapping[str, wp.array]  # arrays that stand on it do not keep it


def allocate_state(problem: Problem, width: int, ground: Mapping[str, wp.array]) -> LbfgsState:
    """Return the state of so many columns on a ground that `allocate_ground` made for at least this width."""
    columns: dict[str, wp.array] = {}
    together: dict[str, wp.array] = {}
    for kind, (_, moved, written) in describe_layout(problem).items():
        first = 0
        for name, shape in {**moved, **written}.items():
            columns[name] = _placed(ground[kind], first, (*shape, width))
            first += width * prod(shape)
        together[kind] = _placed(ground[kind], 0, (_rows(moved), width))
    return LbfgsState(columns, together, ground)


class Workspace:
    """Columns last, on the ground that rooms share. On a graphics card the turn is captured once.

    Parameters
    ----------
    problem, preconditioner
        Whose turns these are.
    width
        How many columns there is workspace for.
    ground
        As `allocate_ground` makes it, for at least this width.
    """

    def __init__(self, problem: Problem, preconditioner: Preconditioner, width: int, ground: Mapping[str, wp.array]):
        self.width = width
        self._problem = problem
        self._preconditioner = preconditioner
        self._kernels = build_kernels(problem.device, PAIRS)
        self._graph: wp.Graph | None = None
        self.state = allocate_state(problem, width, ground)
        self.columns = a = self.state.columns
        self._trial = Balance(a["new_g"], a["part"], a["sums"], a["own"])

    def begin(
        self, start: wp.array, tolerance: np.ndarray, force: np.ndarray, learnt: Mapping[str, np.ndarray]
    ) -> None:
        """Take a batch of at most as many columns, about to judge its start (3N, b)."""
        a, device, spare = self.columns, self._problem.device, self.width - start.shape[1]
        for array in (a["d"], a["g"], a["z"], self.state.moved["double"], self.state.moved["whole"]):
            array.zero_()
        if spare:
            index = self._padded(np.arange(start.shape[1]))
            self._problem.keep(index)
            gather_columns(device, start, index, a["u"])
        else:
            wp.copy(a["u"], start)
        for name, value in (("promised", np.inf), ("residual", np.inf), ("head", PAIRS - 1)):
            a[name].fill_(value)
        # What is there to fill the workspace ends at once.
        a["tolerance"].assign(np.append(tolerance, np.full(spare, np.inf)))
        a["force"].assign(np.append(force, np.full(spare, np.inf)))
        constant, loud = compute_constant_gradients(self._problem, a["u"])
        wp.copy(a["constant"], constant)
        wp.copy(a["loud"], loud)
        for name, rows_first in learnt.items():
            a[name].assign(np.moveaxis(rows_first, 0, -1).reshape(a[name].shape))
        self.prepare()

    def aim(self, g: wp.array, z: wp.array) -> None:
        """The first trial goes along -z (3N, b) from a start that has the free gradient g (3N, b)."""
        a, device, count = self.columns, self._problem.device, g.shape[1]
        index = device.array(self._padded(np.arange(count)), wp.int32)
        gather_columns(device, g, index, a["g"])
        gather_columns(device, z, index, a["z"])
        combine_columns(device, a["d"], -1.0, a["z"], a["d"])
        a["promised"].zero_()
        add_dots(device, a["g"], a["z"], a["promised"])
        a["t"].fill_(1.0)
        self._clamp()

    def take(self, other: Workspace, stay: np.ndarray) -> None:
        """Go on with these columns (k,) of another workspace's batch."""
        index = self._padded(stay)
        self._problem.keep(index)
        there = self._problem.device.array(index, wp.int32)
        for kind, own in self.state.moved.items():
            wp.copy(own, gather_columns(self._problem.device, other.state.moved[kind], there))
        if len(stay) < self.width:
            self.columns["status"][len(stay) :].fill_(DONE)
        self.prepare()

    def _padded(self, stay: np.ndarray) -> np.ndarray:
        """Return the last of them again, until the workspace is full."""
        return np.append(stay, np.full(self.width - len(stay), stay[-1]))

    def prepare(self) -> None:
        """Be ready to turn with what stands here."""
        self.columns["part"].zero_()
        self.columns["bound"].fill_(1.0)
        if self._preconditioner.on_device:
            return
        u = self.columns["u"]
        self._problem.linearise(u, np.zeros(u.shape[1], bool))
        self._preconditioner.prepare(self._problem, u.shape[1])

    def turn(self, times: int) -> None:
        """Turn so many times."""
        device = self._problem.device
        if not (device.on_cuda and self._preconditioner.on_device):
            for _ in range(times):
                self.once()
            return
        if self._graph is None:
            self.once()  # loads what a capture cannot
            if not self.columns["aiming"].numpy().any():
                self._aim()  # nor can it load what no column wanted
            with wp.ScopedCapture(device.name, force_module_load=False) as capture:
                self.once()
            self._graph = capture.graph
            times -= 1
        for _ in range(times):
            wp.capture_launch(self._graph)

    def once(self) -> None:
        """Turn; as a graphics card captures it, unless the preconditioner is the host's."""
        a, k = self.columns, self._kernels
        problem, device = self._problem, self._problem.device
        rows, count = a["u"].shape
        spread, one = lbfgs_trial_kernels.spread_of(device, count), (count,)
        step = lbfgs_trial_kernels.build_kernels(device, spread).step
        device.launch(step, (spread.threads(rows), count), [a["u"], a["t"], a["d"]], [a["v"]])
        found = compute_balance(problem, a["v"], a["constant"], a["d"], self._trial)
        inputs = [a["loud"], found.own, a["tolerance"], a["force"], found.sums, a["promised"]]
        names = ("status", "accepted", "steps", "cut", "t", "gone", "residual", "slot", "aiming")
        device.launch(k.judge, one, inputs, [a[name] for name in names])
        if count == 1 and (not device.on_cuda or wp.is_conditional_graph_supported()):
            wp.capture_if(a["aiming"], self._aim)
        else:
            self._aim()
        inputs = [a["status"], a["accepted"], a["known"], a["slot"], a["gone"], a["along_s"], a["along_w"]]
        outputs = [a["u"], a["d"], a["g"], a["z"], a["s"], a["w"]]
        device.launch(k.move, (-(-rows // get_rows_per_thread(device)), count), [*inputs, found.g, a["new_z"]], outputs)
        self._clamp()

    def _aim(self) -> None:
        """The next direction of the columns that go on, from their new gradients."""
        a, k = self.columns, self._kernels
        problem, device, g = self._problem, self._problem.device, self._trial.g
        rows, count = a["u"].shape
        live = np.ones(count, bool)
        if not self._preconditioner.on_device:  # the host's time is better not spent on trials that failed
            live = a["aiming"].numpy() != 0
        if live.any():
            self._preconditioner.apply(g, live, a["new_z"])
        problem.constraint.project_nodes(a["new_z"])
        a["products"].zero_()
        inputs, outputs = [a["known"], a["s"], a["w"], a["g"], a["z"], g, a["new_z"]], [a["products"]]
        if count == 1 and device.on_cuda:
            dim = (len(a["products"]), lbfgs_trial_kernels.spread_of(device, 1).threads(rows))
            device.launch(multiply_of(device, PAIRS), dim, inputs, outputs)
        else:
            device.launch(k.multiply, (-(-rows // SOME), count), inputs, outputs)
        inputs = [a["aiming"], a["gone"], self._trial.sums, a["products"]]
        outputs = [a["status"], a["head"], a["known"], a["slot"], a["t"], a["promised"]]
        outputs += [a["sg"], a["wg"], a["sy"], a["yw"], a["along_s"], a["along_w"]]
        device.launch(k.aim, (count,), inputs, outputs)

    def _clamp(self) -> None:
        a, bound = self.columns, self.columns["bound"]
        for term in self._problem.terms:
            term.longest_step(a["u"], a["d"], bound)
        self._problem.device.launch(self._kernels.clamp, (self.width,), [], [bound, a["t"]])


def _placed(ground: wp.array, first: int, shape: tuple[int, ...]) -> wp.array:
    """Return the numbers from the first on, as an array of any shape: views of Warp cannot skip 2^31 numbers."""
    address = ground.ptr + first * wp.types.type_size_in_bytes(ground.dtype)
    return wp.array(ptr=address, dtype=ground.dtype, shape=shape, device=ground.device)


def _rows(shapes: Shapes) -> int:
    return sum(prod(shape) for shape in shapes.values())

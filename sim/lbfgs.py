"""L-BFGS from the rest stiffness on a batch of load cases, steered where the numbers are: the host only counts.

One turn evaluates the gradient of every column at its own trial, accepts or cuts that, applies the preconditioner, and
aims anew: always the same launches, so that a graphics card replays them as one captured graph. Between turns the host
drops the columns that have ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from .columns import CHUNK, combined, gathered, norms, scattered
from .linear import Preconditioner
from .problem import Problem
from .steering import FEW, LEFT, LIVE, OWN, PRODUCTS, SOME, SUMS, Kernels, kernels_of

PAIRS = 8
# On CUDA the host looks after so many turns; it drops what has ended once that is such a share of the columns.
TURNS_ON_CUDA, ENDED = 2, 0.15
# What a descent has learnt about the curvature, on the host, rows first: s and w (b, m, 3N), their products (b, m, m),
# the newest pair and how many there are (b,).
LEARNT = ("s", "w", "sy", "yw", "head", "known")
# Learnt curvature travels with the answers of so few load cases: a larger batch has no next frame.
TAUGHT = 4


@dataclass(frozen=True, eq=False)
class Descended:
    """u (3N, b) [m] on the device; (b,) on the host: status, accepted steps, relative residuals; what was `LEARNT`."""

    u: wp.array
    status: np.ndarray
    steps: np.ndarray
    residual: np.ndarray
    learnt: Mapping[str, np.ndarray]

    @property
    def left(self) -> np.ndarray:
        """(k,): columns whose descent did not end, and another may go on with."""
        return np.flatnonzero((self.status == LIVE) | (self.status == LEFT))


def descend(
    problem: Problem,
    preconditioner: Preconditioner,
    start: wp.array,
    tolerance: np.ndarray,
    most: int,
    learnt: Mapping[str, np.ndarray] | None = None,
) -> Descended:
    """Minimise the potential of a problem that has begun a batch, from start (3N, b) [m], in at most `most` turns.

    The start satisfies the constraints, and no footprint is moved. tolerance (b,), relative as `Problem.residual` has
    it. `learnt`, if any, is what an earlier descent of the same problem found out, near here it is hoped. Every u is
    the last accepted state of its column.
    """
    device, count = problem.device, start.shape[1]
    u, place = wp.clone(start), np.arange(count)
    status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
    if count == 0:
        return Descended(u, status, steps, residual, {})
    work, turns = _begun(problem, preconditioner, start, tolerance, learnt or {}), 0
    while True:
        more = min(TURNS_ON_CUDA if device.on_cuda else 1, most - turns)
        work.turn(more)
        turns += more
        now = work.status.numpy()
        last = turns >= most or not (now == LIVE).any()
        if last or ((now != LIVE).mean() >= ENDED and count > TAUGHT):
            leave = np.flatnonzero(now != LIVE) if not last else np.arange(len(now))
            there = place[leave]
            scattered(device, gathered(device, work.u, leave), there, u)
            status[there], steps[there], residual[there] = (
                array.numpy()[leave] for array in (work.status, work.steps, work.residual)
            )
            if last:
                learnt = {name: _rows_first(work.columns[name]) for name in LEARNT} if count <= TAUGHT else {}
                return Descended(u, status, steps, residual, learnt)
            stay = np.flatnonzero(now == LIVE)
            place, work = place[stay], work.kept(stay)


@dataclass(eq=False)
class _Work:
    """Everything that the columns of a batch carry from turn to turn; columns last."""

    problem: Problem
    preconditioner: Preconditioner
    kernels: Kernels
    columns: dict[str, wp.array]
    scratch: dict[str, wp.array]
    graph: wp.Graph | None = None

    @property
    def u(self) -> wp.array:
        return self.columns["u"]

    @property
    def status(self) -> wp.array:
        return self.columns["status"]

    @property
    def steps(self) -> wp.array:
        return self.columns["steps"]

    @property
    def residual(self) -> wp.array:
        return self.columns["residual"]

    def kept(self, stay: np.ndarray) -> _Work:
        """The same work on these columns (k,)."""
        device = self.problem.device
        index = device.array(stay, wp.int32)
        self.problem.keep(stay)
        columns = {name: gathered(device, array, index) for name, array in self.columns.items()}
        _prepare(self.problem, self.preconditioner, columns["u"])
        return _Work(self.problem, self.preconditioner, self.kernels, columns, _scratch(self.problem, len(stay)))

    def turn(self, times: int) -> None:
        """Turn so many times."""
        device = self.problem.device
        if not (device.on_cuda and self.preconditioner.on_device):
            for _ in range(times):
                self._turn()
            return
        if self.graph is None:
            self._turn()  # loads what a capture cannot
            with wp.ScopedCapture(device.name, force_module_load=False) as capture:
                self._turn()
            self.graph = capture.graph
            times -= 1
        for _ in range(times):
            wp.capture_launch(self.graph)

    def _turn(self) -> None:
        a, b, k = self.columns, self.scratch, self.kernels
        problem, device = self.problem, self.problem.device
        rows, count = a["u"].shape
        one, some = (count,), (-(-rows // SOME), count)
        device.launch(k.step, some, [a["u"], a["t"], a["d"]], [b["v"]])
        own = self._evaluate()
        inputs = [a["loudest"], own, a["tolerance"], b["sums"], a["promised"]]
        outputs = [a["status"], b["accepted"], a["steps"], a["cut"], a["t"], b["gone"], a["residual"]]
        device.launch(k.judge, one, inputs, outputs)
        live = np.ones(count, bool)
        if not self.preconditioner.on_device:  # the host's time is better not spent on trials that failed
            live = (b["accepted"].numpy() != 0) & (a["status"].numpy() == LIVE)
        if live.any():
            self.preconditioner.apply(b["g"], live, b["z"])
        problem.constraint.project_nodes(b["z"])
        b["products"].zero_()
        inputs = [a["known"], a["s"], a["w"], a["g"], a["z"], b["g"], b["z"]]
        device.launch(k.multiply, some, inputs, [b["products"]])
        inputs = [b["accepted"], b["gone"], b["sums"], b["products"]]
        outputs = [a["status"], a["head"], a["known"], b["slot"], a["t"], a["promised"]]
        outputs += [a["sg"], a["wg"], a["sy"], a["yw"], b["along_s"], b["along_w"]]
        device.launch(k.aim, one, inputs, outputs)
        inputs = [a["status"], b["accepted"], a["known"], b["slot"], b["gone"], b["along_s"], b["along_w"]]
        outputs = [a["u"], a["d"], a["g"], a["z"], a["s"], a["w"]]
        device.launch(k.move, (-(-rows // FEW), count), [*inputs, b["g"], b["z"]], outputs)
        for term in problem.terms:
            term.longest_step(a["u"], a["d"], b["bound"])
        device.launch(k.clamp, one, [], [b["bound"], a["t"]])

    def _evaluate(self) -> wp.array:
        """Leave the trials' projected gradient in g (3N, b), and its sums; square norms (terms, b) of its parts."""
        a, b, k = self.columns, self.scratch, self.kernels
        problem, device = self.problem, self.problem.device
        rows, count = a["u"].shape
        b["sums"].zero_()
        wp.copy(b["g"], a["constant"])
        varying = [term for term in problem.terms if not term.constant]
        own = b["sums"][OWN : OWN + 1]  # of the only one
        if len(varying) == 1:
            varying[0].add_gradient(b["v"], b["g"])
        else:
            own = b["own"]
            own.zero_()
            for number, term in enumerate(varying):
                term.add_gradient(b["v"], b["part"])
                device.launch(k.absorb, (-(-rows // CHUNK), count), [], [b["part"], b["g"], own[number]])
        inputs = [a["constant"], *problem.constraint.nodes, a["d"]]
        device.launch(k.finish, (-(-rows // (3 * SOME)), count), inputs, [b["g"], b["sums"]])
        return own


def _begun(
    problem: Problem,
    preconditioner: Preconditioner,
    start: wp.array,
    tolerance: np.ndarray,
    learnt: Mapping[str, np.ndarray],
) -> _Work:
    device, (rows, count) = problem.device, start.shape
    _prepare(problem, preconditioner, start)
    constant, loudest = device.zeros(rows, count), np.zeros(count)
    for term in problem.terms:
        if term.constant:
            own = device.zeros(rows, count)
            term.add_gradient(start, own)
            loudest = np.maximum(loudest, norms(device, own))
            combined(device, constant, np.ones(count), own, constant)

    def doubles(*shape: int, value: float = 0.0) -> wp.array:
        return wp.full((*shape, count), value, dtype=wp.float64, device=device.name)

    def whole(value: int = 0) -> wp.array:
        return wp.full(count, value, dtype=wp.int32, device=device.name)

    columns = {
        **{name: device.zeros(rows, count) for name in ("d", "g", "z")},
        **{name: device.zeros(PAIRS, rows, count) for name in ("s", "w")},
        **{name: doubles(PAIRS) for name in ("sg", "wg")},
        **{name: doubles(PAIRS, PAIRS) for name in ("sy", "yw")},
        **{name: whole() for name in ("steps", "cut", "known")},
        "u": wp.clone(start),
        "constant": constant,
        "loudest": device.array(loudest, wp.float64),
        "tolerance": device.array(tolerance, wp.float64),
        "t": doubles(),
        "promised": doubles(value=np.inf),
        "residual": doubles(value=np.inf),
        "status": whole(LIVE),
        "head": whole(PAIRS - 1),
    }
    for name, rows_first in learnt.items():
        columns[name].assign(np.moveaxis(rows_first, 0, -1).reshape(columns[name].shape))
    return _Work(problem, preconditioner, kernels_of(device, PAIRS), columns, _scratch(problem, count))


def _rows_first(array: wp.array) -> np.ndarray:
    return np.moveaxis(array.numpy(), -1, 0)


def _prepare(problem: Problem, preconditioner: Preconditioner, u: wp.array) -> None:
    """For the columns of u (3N, b)."""
    problem.linearise(u, np.zeros(u.shape[1], bool))
    preconditioner.prepare(problem, u.shape[1])


def _scratch(problem: Problem, count: int) -> dict[str, wp.array]:
    device, rows = problem.device, problem.rows

    def doubles(*shape: int) -> wp.array:
        return wp.zeros((*shape, count), dtype=wp.float64, device=device.name)

    return {
        **{name: device.zeros(rows, count) for name in ("v", "g", "z", "part")},
        **{name: doubles(PAIRS) for name in ("along_s", "along_w")},
        **{name: wp.zeros(count, dtype=wp.int32, device=device.name) for name in ("accepted", "slot")},
        "sums": doubles(SUMS),
        "products": doubles(2 * PAIRS + PRODUCTS),
        "own": doubles(len(problem.terms)),
        "gone": doubles(),
        "bound": wp.full(count, 1.0, dtype=device.scalar, device=device.name),
    }

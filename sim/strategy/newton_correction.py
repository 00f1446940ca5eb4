"""One step towards equilibrium from states that somebody else made, and what is still missing after it.

Near a tool a prediction is far from equilibrium, and a linear solve from there misleads. So what a load strains most is
first settled by itself, beside the rest (one cycle of nonlinear elimination). Then K(u) d = -g is solved for the rest
of the error, and gone along as far as the line search allows.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..deformation import Outcome
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from ..linalg.pcg import LinearSolution, conjugate_gradients
from ..minimisers.line_search import search
from ..minimisers.newton_cg import Direction
from ..minimisers.residual import relative
from ..runtime.columns import combined, dots
from .strategy import Answer, Strategy


@dataclass(frozen=True)
class Linear:
    """The linear residual that may be left, and the most iterations: after the local solver more are not seen."""

    forcing: float = 0.2
    iterations: int = 12


@dataclass(frozen=True, eq=False)
class Step:
    """Where one step from B states led.

    answer
        The states there; an outcome is good where the residual is within the tolerance.
    before
        (B,) relative residuals where it began.
    left
        (3N, B) [m] on the device: how the rest stiffness answers what is still out of balance.
    seconds
        Wall time of settling what is strained most, of the linear solve, and of the search along its direction.
    """

    answer: Answer
    before: np.ndarray
    left: wp.array
    seconds: dict[str, float]


def step_from(strategy: Strategy, cases: Cases, guess: np.ndarray, linear: Linear = Linear()) -> Step:
    """One step from guess (3N, B) [m], which is first put on the constraints.

    From rest where the guess may be turned over, or the law is infinite there.
    """
    problem, device, count = strategy.problem, strategy.problem.device, len(cases.loads)
    clocks = [time.perf_counter()]
    problem.begin(cases)

    def put(start: wp.array) -> wp.array:
        return combined(device, start, 1.0, problem.gap(start)[0], start)

    start = device.array(guess)
    turned, u = strategy.inversion.doubtful(strategy.inversion.count(start)), put(start)
    _, free, scale = problem.residual(u)
    turned |= ~np.isfinite(free)
    if turned.any():
        u = put(device.array(np.where(turned, 0.0, guess)))
        _, free, scale = problem.residual(u)
    before = relative(free, scale)
    step = strategy.plan.local(count)
    near = strategy.local(count) if step is not None and step.eliminates else strategy.near()
    if near is not None and not problem.constraint.imposes:
        u = near.descend(u, np.full(count, strategy.accuracy.tolerance), 1).u
        problem.begin(cases)  # columns that were done have left
    g, free, _ = problem.residual(u)
    clocks.append(time.perf_counter())
    rhs = combined(device, device.zeros(*g.shape), -1.0, g, wp.empty_like(g))
    found = _solved(problem, strategy, u, rhs, linear.forcing * free, linear.iterations)
    clocks.append(time.perf_counter())
    length = search(problem, u, Direction(found.x, dots(device, rhs, found.x), found.iterations))
    u = combined(device, u, length, found.x, wp.empty_like(u))
    g, free, scale = problem.residual(u)
    after, left = relative(free, scale), wp.zeros_like(g)
    strategy.preconditioner.apply(g, np.ones(count, bool), left)
    problem.constraint.project(left)
    combined(device, wp.zeros_like(left), -1.0, left, left)
    clocks.append(time.perf_counter())
    good = after <= strategy.accuracy.tolerance
    outcome = np.full(count, Outcome.BUDGET, object)
    outcome[good] = Outcome.CONVERGED
    steps, reached = np.ones(count, int), good.astype(float)
    answer = Answer(u, outcome, steps, after, reached, strategy.inversion.count(u), found.iterations)
    relax, solve, along = np.diff(clocks).tolist()
    return Step(answer, before, left, {"relax": relax, "solve": solve, "search": along})


def _solved(
    problem: Problem, strategy: Strategy, u: wp.array, rhs: wp.array, tolerance: np.ndarray, most: int
) -> LinearSolution:
    """K(u) d = rhs (3N, B) to `tolerance` (B,) [N], in at most so many iterations.

    Columns whose curvature is negative on the way are solved anew. There the curvature at rest stands in wherever the
    current one is not definite.
    """
    found, definite = None, np.zeros(rhs.shape[1], bool)
    while found is None or (found.truncated & ~definite).any():
        if found is not None:
            definite = definite | found.truncated
        problem.linearise(u, definite)
        strategy.preconditioner.prepare(problem, rhs.shape[1])
        found = conjugate_gradients(problem, strategy.preconditioner, wp.clone(rhs), tolerance, most)
    return found

"""Outer loop of nonlinear elimination: solutions of local and whole problem alternate until equilibrium.

Cai, Keyes 2002, "Nonlinearly preconditioned inexact Newton algorithms", SIAM J. Sci. Comput. 24:183-200. The local
solver defines one cycle; this module determines when the cycles of each load case end.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..minimisers.lbfgs import DescentResult
from ..minimisers.lbfgs_kernels import DONE, LIVE, NOT_FINITE
from ..minimisers.residual import ResidualEvaluator, ResidualState, build_evaluator
from ..runtime.columns import scatter_columns


@dataclass(frozen=True)
class CycleLimits:
    """Limits of the cycles, and accuracy of the local solution.

    Parameters
    ----------
    max_cycles
        Maximum number of cycles.
    patience
        Number of cycles within which the residual must be halved; otherwise another solver continues.
    max_rise
        Maximum residual relative to the initial residual. Strong loads cause large residuals; above it they diverge.
    forcing, tolerance_factor
        Residual of the local solution: the larger of these fractions of the whole residual and of the tolerance.
    """

    max_cycles: int = 20
    patience: int = 5
    max_rise: float = 30.0
    forcing: float = 0.03
    tolerance_factor: float = 0.3


DEFAULT_CYCLE_LIMITS = CycleLimits()  # Default.
Cycle = Callable[[ResidualEvaluator, ResidualState, np.ndarray], ResidualState]
"""Function (evaluator, states, local tolerance (b,) [N]) that returns the next states of b load cases. A load case
without an accepted step has a residual that is not finite."""


def run_cycles(
    problem: Problem, start: wp.array, tolerance: np.ndarray, max_cycles: int, limits: CycleLimits, cycle: Cycle
) -> DescentResult:
    """Return the result, as `Lbfgs.descend`, after at most `max_cycles` cycles from `start` (3N, b) [m]; no history.

    The final state of each load case is within its tolerance (b,), or has the smallest residual of all cycles.
    """
    device, count = problem.device, start.shape[1]
    judge = build_evaluator(problem, start)
    now, result, live = judge(start), wp.clone(start), np.arange(count)
    status, steps, residual = np.where(now.is_finite, LIVE, NOT_FINITE), np.zeros(count, int), np.full(count, np.inf)
    first, least, mark, idle = now.norm, np.full(count, np.inf), np.full(count, np.inf), np.zeros(count, int)
    last = min(limits.max_cycles, max_cycles)
    for number in range(last + 1):
        sane = now.is_finite & ~(now.norm > limits.max_rise * first[live])
        # Diverging forces raise the scale, and so lower the relative residual.
        done = sane & (now.norm <= first[live]) & (now.relative <= tolerance[live])
        better = done | (sane & (now.norm <= np.fmin(first, least)[live]))
        scatter_columns(device, now.u, live[better], result, np.flatnonzero(better))
        least[live[better]], residual[live[better]] = now.norm[better], now.relative[better]
        steps[live[sane]], status[live[done]] = number, DONE
        halved = now.norm <= 0.5 * mark[live]
        mark[live[halved]] = now.norm[halved]
        idle[live] = np.where(halved, 0, idle[live] + 1)
        stay = np.flatnonzero(sane & ~done & (idle[live] < limits.patience))
        if number == last or len(stay) == 0:
            break
        if len(stay) < len(live):
            judge, now, live = judge.select(stay), now.select(device, stay), live[stay]
        goal = limits.tolerance_factor * tolerance[live] * now.scale
        now = cycle(judge, now, np.fmax(limits.forcing * now.norm, goal))
    return DescentResult(result, status, steps, residual, {})

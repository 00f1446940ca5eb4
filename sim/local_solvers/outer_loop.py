"""Outer loop of nonlinear elimination: local subproblem and whole problem alternate until equilibrium.

Cai, Keyes 2002, "Nonlinearly preconditioned inexact Newton algorithms", SIAM J. Sci. Comput. 24:183-200. The local
solver defines one cycle; this module decides for each load case of a batch when cycles end.
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
        Cycles within which the residual must be halved; otherwise another solver takes over.
    max_rise
        Largest residual relative to the start's. Strong loads pass through large residuals; beyond this they diverge.
    forcing, tolerance_factor
        Residual of the local solution: fraction of the whole residual, or of the tolerance if larger.
    """

    max_cycles: int = 20
    patience: int = 5
    max_rise: float = 30.0
    forcing: float = 0.03
    tolerance_factor: float = 0.3


DEFAULT_CYCLE_LIMITS = CycleLimits()  # Default.
Cycle = Callable[[ResidualEvaluator, ResidualState, np.ndarray], ResidualState]
"""Function that returns the next states of b load cases; the local solution may keep residuals (b,) [N]. A load case
without an accepted step gets a residual that is not finite."""


def run_cycles(
    problem: Problem, start: wp.array, tolerance: np.ndarray, max_cycles: int, limits: CycleLimits, cycle: Cycle
) -> DescentResult:
    """Iterate from start (3N, b) [m], as `Lbfgs.descend`, in at most `max_cycles` cycles; returns no L-BFGS history.

    Each load case ends in the state with its smallest residual, or within its tolerance (b,).
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

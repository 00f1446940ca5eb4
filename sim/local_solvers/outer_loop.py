"""The outer loop of nonlinear elimination: local problem, whole body, local problem, until the whole is in equilibrium.

Cai, Keyes 2002, "Nonlinearly preconditioned inexact Newton algorithms", SIAM J. Sci. Comput. 24:183-200. What one cycle
does is the local solver's own; when cycles end is decided here, for each column of a batch by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..minimisers.lbfgs import Descended
from ..minimisers.lbfgs_kernels import BROKEN, DONE, LIVE
from ..minimisers.residual import Judge, ResidualState, build_judge
from ..runtime.columns import scatter_columns


@dataclass(frozen=True)
class CycleLimits:
    """When cycles end, and how exactly each solves its local problem.

    Parameters
    ----------
    cycles
        Most.
    patience
        A column whose free force was not halved in so many cycles is left to another solver.
    rise
        Hard loads pass through states whose free force is so many times the start's. Beyond that they have exploded.
    forcing, enough
        The local problem is solved to this share of the whole free force, or of the tolerance: more would not be felt.
    """

    cycles: int = 20
    patience: int = 5
    rise: float = 30.0
    forcing: float = 0.03
    enough: float = 0.3


USUAL = CycleLimits()
Cycle = Callable[[Judge, ResidualState, np.ndarray], ResidualState]
"""The next states (b columns), of these; the local problem may keep free forces (b,) [N]. A column that finds no way
on has a free force that is not finite."""


def run_cycles(
    problem: Problem, start: wp.array, tolerance: np.ndarray, most: int, limits: CycleLimits, cycle: Cycle
) -> Descended:
    """Go on from start (3N, b) [m], as `Lbfgs.descend`, in at most `most` cycles; nothing is learnt.

    Each column is left where its free force was least, or where it came within its tolerance (b,).
    """
    device, count = problem.device, start.shape[1]
    judge = build_judge(problem, start)
    now, result, live = judge(start), wp.clone(start), np.arange(count)
    status, steps, residual = np.where(now.finite, LIVE, BROKEN), np.zeros(count, int), np.full(count, np.inf)
    first, least, mark, idle = now.free, np.full(count, np.inf), np.full(count, np.inf), np.zeros(count, int)
    last = min(limits.cycles, most)
    for number in range(last + 1):
        sane = now.finite & ~(now.free > limits.rise * first[live])
        # Forces that explode lower the relative residual.
        done = sane & (now.free <= first[live]) & (now.relative <= tolerance[live])
        better = done | (sane & (now.free <= np.fmin(first, least)[live]))
        scatter_columns(device, now.u, live[better], result, np.flatnonzero(better))
        least[live[better]], residual[live[better]] = now.free[better], now.relative[better]
        steps[live[sane]], status[live[done]] = number, DONE
        halved = now.free <= 0.5 * mark[live]
        mark[live[halved]] = now.free[halved]
        idle[live] = np.where(halved, 0, idle[live] + 1)
        stay = np.flatnonzero(sane & ~done & (idle[live] < limits.patience))
        if number == last or len(stay) == 0:
            break
        if len(stay) < len(live):
            judge, now, live = judge.rows(stay), now.rows(device, stay), live[stay]
        now = cycle(judge, now, np.fmax(limits.forcing * now.free, limits.enough * tolerance[live] * now.scale))
    return Descended(result, status, steps, residual, {})

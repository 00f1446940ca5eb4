"""The outer iteration: a direction times a search, until the accuracy or the budget is reached.

Knows terms only by their protocol. Cases that are done leave the batch, so that the rest costs less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .accuracy import Accuracy
from .columns import combined, gathered
from .deformation import Outcome
from .direction import NewtonCG
from .problem import Problem
from .search import search


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """Where the iteration ended: u (3N, B) [m] on the host, outcomes, outer steps, relative residuals (B,)."""

    u: np.ndarray
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    linear_iterations: int


def find_equilibrium(problem: Problem, direction: NewtonCG, start: np.ndarray, accuracy: Accuracy) -> Equilibrium:
    """Minimise the potential of a problem that has begun a batch, from start (3N, B) [m].

    The last finite, accepted state of every case is returned, whatever its outcome.
    """
    device, count = problem.device, start.shape[1]
    result = start.copy()
    outcome = np.full(count, Outcome.BUDGET, object)
    iterations, residual = np.zeros(count, int), np.full(count, np.inf)
    u, live = device.array(start), np.arange(count)
    definite, failed = np.zeros(count, bool), np.zeros(count, bool)
    slack = 100.0 * np.finfo(device.precision).eps
    linear_iterations = 0
    for step in range(accuracy.outer + 1):
        g, free, scale = problem.residual(u)
        gap, gap_size = problem.constraint.close_gap(u)
        values = u.numpy()
        open_gap = gap_size > slack * np.abs(values).max(axis=0, initial=0.0)
        with np.errstate(invalid="ignore"):
            relative = np.divide(free, scale, out=np.zeros_like(free), where=scale != 0.0)
        bad = ~np.isfinite(relative)
        done = ~bad & ~open_gap & (relative <= accuracy.tolerance)
        outcome[live[done]] = Outcome.CONVERGED
        outcome[live[failed & ~done]] = Outcome.STALLED
        outcome[live[bad]] = Outcome.NOT_FINITE
        iterations[live], residual[live] = step, np.where(bad, np.inf, relative)
        result[:, live[~bad]] = values[:, ~bad]
        stay = np.flatnonzero(~(done | bad | failed))
        if len(stay) == 0 or step == accuracy.outer:
            break
        if len(stay) < len(live):
            problem.keep(stay)
            u, g, gap = (gathered(device, array, stay) for array in (u, g, gap))
            live, definite, open_gap = live[stay], definite[stay], open_gap[stay]
            relative = relative[stay]
        # Inexact Newton: superlinear, and never finer than the tolerance needs.
        forcing = np.clip(np.sqrt(relative), 0.3 * accuracy.tolerance / np.maximum(relative, 1e-300), 0.1)
        found = direction.find(problem, u, g, gap if open_gap.any() else None, forcing, definite)
        linear_iterations += found.iterations
        length = search(problem, u, found)
        combined(device, u, length, found.d, u)
        # A search that fails is repeated once along a direction of positive definite curvature.
        failed = (length == 0.0) & definite
        definite = length == 0.0
    return Equilibrium(result, outcome, iterations, residual, linear_iterations)

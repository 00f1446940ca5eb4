"""Newton's method: search direction and line search, until the tolerance or the iteration limit is reached.

Terms are used only through the interface `Term`. Load cases that have ended are removed from the batch to save time.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..accuracy import Accuracy
from ..deformation import Outcome
from ..discretisation.problem import Problem
from ..runtime.columns import combine_columns, compute_norms, gather_columns, scatter_columns
from ..runtime.device import Device
from .line_search import search_line
from .newton_cg import DescentMethod
from .residual import compute_relative_residual


@dataclass(frozen=True)
class Newton:
    """Settings of Newton's method: accuracy of the linear solves, and criteria for stalling and round-off.

    Parameters
    ----------
    max_forcing
        Upper bound of the relative linear residual of the inexact Newton method.
    patience
        If the residual has not decreased by 10 % in this number of iterations, the residual is compared with round-off.
    max_stalled
        A load case stalls after this number of successive iterations with steps below the last digit of u. Fewer such
        iterations may be due to a small trust radius after a short step, which then doubles again.
    round_off
        The residual is round-off if it is below this factor times its change by the last digit of every
        displacement.
    stress_free
        The model is stress-free if the nodal forces of each term are below this factor times that change of forces.
    """

    max_forcing: float = 0.25
    patience: int = 4
    max_stalled: int = 16
    round_off: float = 4.0
    stress_free: float = 100.0


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """Final states: u (3N, B) [m] on the device; outcomes, outer iterations and relative residuals (B,)."""

    u: wp.array
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    linear_iterations: int


def find_equilibrium(
    problem: Problem, descent: DescentMethod, start: wp.array, accuracy: Accuracy, settings: Newton = Newton()
) -> Equilibrium:
    """Minimise the energy of the current batch of a problem, from `start` (3N, B) [m].

    The result has the last finite, accepted state of every load case, for any outcome. A load case counts as converged
    if all its forces vanish compared with the initial forces, since the relative residual is then undefined.
    """
    device, count = problem.device, start.shape[1]
    outcome = np.full(count, Outcome.BUDGET, object)
    iterations, residual = np.zeros(count, int), np.full(count, np.inf)
    result, u, before, live = wp.clone(start), wp.clone(start), start, np.arange(count)
    gap, open_gap = problem.compute_gap(u)
    taken, failed = np.ones(count), np.zeros(count, bool)
    first, best, (idle, still) = np.zeros(count), np.full(count, np.inf), np.zeros((2, count), int)
    last_digit = np.finfo(device.precision).eps
    linear_iterations = 0
    descent.begin()
    for step in range(accuracy.outer + 1):
        g, free, scale = problem.residual(u)
        first[live] = scale if step == 0 else first[live]
        if step and open_gap.any():  # projected directions keep closed constraints closed
            gap, open_gap = problem.compute_gap(u)
        vanished = scale <= last_digit**2 * first[live]
        share = compute_relative_residual(free, np.where(vanished, 0.0, scale))
        bad = ~np.isfinite(share)
        done = ~bad & ~open_gap & (share <= accuracy.tolerance)
        idle[live] = np.where(share <= 0.9 * best[live], 0, idle[live] + 1)
        best[live] = np.fmin(best[live], share)
        stuck = ~done & ~bad & (failed | (idle[live] >= settings.patience))
        still[live] *= stuck
        if stuck.any():
            moved = compute_norms(device, combine_columns(device, u, -1.0, before, wp.empty_like(u)))
            still[live] += stuck & (moved <= last_digit * compute_norms(device, u))
            failed |= still[live] >= settings.max_stalled
            drowned = stuck & ~open_gap & (free <= settings.round_off * compute_round_off(problem, u, g))
            outcome[live[failed]] = Outcome.STALLED
            outcome[live[drowned]] = Outcome.ROUND_OFF
            failed |= drowned
            if drowned.any():
                relaxed = drowned & is_stress_free(problem, u, settings.stress_free)
                share, done = np.where(relaxed, 0.0, share), done | relaxed
        outcome[live[done]] = Outcome.CONVERGED
        outcome[live[bad]] = Outcome.NOT_FINITE
        iterations[live], residual[live] = step, np.where(bad, np.inf, share)
        leave = done | bad | failed
        last = leave.all() or step == accuracy.outer
        for state, columns in ((u, ~bad & (leave | last)), (before, bad)):
            scatter_columns(device, state, live[columns], result, np.flatnonzero(columns))
        if last:
            break
        if leave.any():
            stay = np.flatnonzero(~leave)
            problem.keep(stay)
            descent.keep(device, stay)
            u, g, gap = (gather_columns(device, array, stay) for array in (u, g, gap))
            live, taken, open_gap, share = live[stay], taken[stay], open_gap[stay], share[stay]
        # Superlinear, and never finer than the tolerance needs.
        forcing = np.clip(np.sqrt(share), 0.3 * accuracy.tolerance / np.maximum(share, 1e-300), settings.max_forcing)
        found = descent.find_direction(problem, u, g, gap if open_gap.any() else None, forcing, taken)
        linear_iterations += found.iterations
        length = search_line(problem, u, found)
        before, u = u, combine_columns(device, u, length, found.d, wp.empty_like(u))
        # A failed search is repeated once along a direction of positive definite curvature.
        failed = (length == 0.0) & (taken == 0.0)
        taken = length
    return Equilibrium(result, outcome, iterations, residual, linear_iterations)


def compute_round_off(problem: Problem, u: wp.array, g: wp.array) -> np.ndarray:
    """Return the change (b,) [N] of the residual g (3N, b) at u (3N, b) by the last digit of every displacement.

    The residual cannot be smaller, since the required displacements are not representable in the floating-point type.
    """
    device = problem.device
    near = problem.gradient(_perturb_last_digit(device, u))
    problem.constraint.project(near)
    return compute_norms(device, combine_columns(device, near, -1.0, g, near))


def is_stress_free(problem: Problem, u: wp.array, factor: float) -> np.ndarray:
    """Return a mask (b,) of load cases in which the forces of each term at each node are round-off at u (3N, b).

    Round-off is `factor` times the force change by the last digit of every displacement, at this node or at the median
    node, whichever is larger; so the large round-off of a sliver counts only at its own nodes.
    """

    def compute_node_norms(force: wp.array) -> np.ndarray:
        return np.linalg.norm(force.numpy().reshape(-1, 3, u.shape[1]), axis=1)

    change = wp.empty_like(u)
    combine_columns(
        problem.device, problem.gradient(_perturb_last_digit(problem.device, u)), -1.0, problem.gradient(u), change
    )
    noise = compute_node_norms(change)
    out = np.ones(u.shape[1], bool)
    for term in problem.terms:
        own = wp.zeros_like(u)
        term.add_gradient(u, own)
        out &= (compute_node_norms(own) <= factor * np.maximum(noise, np.median(noise, axis=0))).all(axis=0)
    return out


def _perturb_last_digit(device: Device, u: wp.array) -> wp.array:
    """Return the displacements u (3N, b) with the last digit of each value changed, up or down at random."""
    values = u.numpy()
    sign = np.random.default_rng(0).choice([-1.0, 1.0], (len(values), 1))
    return device.upload(values * (1.0 + sign * np.finfo(device.precision).eps))

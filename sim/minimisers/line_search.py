"""Line search that uses directional derivatives.

Energies are not compared, since in single precision their differences reach round-off much earlier than gradients.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..runtime.columns import combine_columns, compute_dots
from .lbfgs_kernels import DEFAULT_BACKTRACK, MAX_BACKTRACK, MIN_BACKTRACK, OVERSHOOT
from .newton_cg import Direction


@dataclass(frozen=True)
class LineSearch:
    """Settings of the line search.

    Parameters
    ----------
    undershoot, max_refinements
        A shortened step whose slope is still steeper than this fraction of the initial slope is lengthened again, at
        most this number of times.
    max_trials
        Maximum number of trial lengths.
    min_length
        Minimum step length; a shorter step counts as a failure.
    """

    undershoot: float = 0.5
    max_refinements: int = 4
    max_trials: int = 16
    min_length: float = 1e-8


def is_step_too_long(slope: Any, predicted: Any) -> Any:
    """Return True for steps whose slope exceeds `OVERSHOOT` times the predicted decrease, or is not finite."""
    return ~(np.asarray(slope) <= OVERSHOOT * np.abs(predicted))


def backtrack_by_slopes(slope: Any, predicted: Any) -> Any:
    """Return the backtracking factors of rejected steps: zero of the secant through both end slopes, within bounds."""
    with np.errstate(invalid="ignore", divide="ignore"):
        kept = np.divide(predicted, np.add(predicted, slope))
    known = np.greater(predicted, 0.0) & np.isfinite(slope)
    return np.clip(np.where(known, kept, DEFAULT_BACKTRACK), MIN_BACKTRACK, MAX_BACKTRACK)


def search_line(problem: Problem, u: wp.array, direction: Direction, settings: LineSearch = LineSearch()) -> np.ndarray:
    """Return step lengths (b,) in (0, 1] along a direction from u (3N, b); 0 if no length is accepted.

    A length t is accepted if phi'(t) <= 0.5 x the predicted decrease: the energy still decreases, or its minimum along
    the line was just passed. The search keeps the longest accepted and the shortest rejected length; the secant through
    the slopes at these two lengths gives the next trial.
    """
    t = problem.longest_step(u, direction.d)
    predicted = direction.decrease
    low, high = np.zeros(len(t)), np.full(len(t), np.inf)
    slope_low, slope_high = -predicted, np.full(len(t), np.inf)
    found, refinements = np.zeros(len(t), bool), np.zeros(len(t), int)
    trial = problem.device.allocate(*u.shape)
    for _ in range(settings.max_trials):
        g = problem.gradient(combine_columns(problem.device, u, t, direction.d, trial))
        problem.constraint.project(g)
        slope = compute_dots(problem.device, g, direction.d)
        slope = np.where(np.isfinite(slope), slope, 3.0 * np.abs(predicted))
        far = ~found & (slope > OVERSHOOT * predicted)
        near = ~found & ~far
        low, slope_low = np.where(near, t, low), np.where(near, slope, slope_low)
        high, slope_high = np.where(far, t, high), np.where(far, slope, slope_high)
        short = near & (slope < -settings.undershoot * predicted) & np.isfinite(high)
        refinements += short | (far & (low > 0.0))
        found |= (near & ~short) | (refinements >= settings.max_refinements)
        if found.all():
            break
        with np.errstate(invalid="ignore"):
            share = np.clip(slope_low / (slope_low - slope_high), MIN_BACKTRACK, MAX_BACKTRACK)
            t = np.where(found, low, low + share * (high - low))
    return np.where(low >= settings.min_length, low, 0.0)

"""Line search on the directional derivative.

Energies are not compared: in single precision their differences drown in round-off long before the gradient does.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .columns import combined, dots
from .direction import Direction
from .problem import Problem

# The slope ahead may rise to this share of the promised decrease: a Newton step that overshoots more is cut.
OVERSHOOT = 0.5
TRIALS = 16


def search(problem: Problem, u: wp.array, direction: Direction) -> np.ndarray:
    """Step lengths (b,) in (0, 1] along a direction from u (3N, b); zero where none was found.

    A length is accepted when phi'(t) <= 0.5 x the promised decrease: the energy still falls, or its minimum along
    the line is not far behind. Otherwise the secant through phi'(0) = -promised and phi'(t) gives the next trial.
    """
    t = problem.longest_step(u, direction.d)
    found = np.zeros(len(t), bool)
    trial = problem.device.zeros(*u.shape)
    for _ in range(TRIALS):
        g = problem.gradient(combined(problem.device, u, t, direction.d, trial))
        problem.constraint.project(g)
        slope = dots(problem.device, g, direction.d)
        finite = np.isfinite(slope)
        found |= finite & (slope <= OVERSHOOT * direction.promised)
        if found.all():
            break
        secant = direction.promised / (direction.promised + np.where(finite, slope, 3.0 * np.abs(direction.promised)))
        t = np.where(found, t, t * np.clip(secant, 0.1, 0.7))
    return np.where(found, t, 0.0)

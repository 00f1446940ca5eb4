"""Extrapolated starts of frames: the last solution plus a multiple of its change from the previous solution.

Between similar loads, the solution is nearly linear in the load. After loads q, p with solutions v, u, the solution for
p' starts from u + a (u - v), a = (p' - p) . (p - q) / |p - q|^2, the component of the new load step along the last load
step. a is zero if the load does not change or turns by 90 degrees, and negative if the load returns.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arguments import is_all_finite
from ..loads import Loads, Pushed

# Warm-start keys: loads of the solution and of the one before (B, 2, 7); displacements (B, 3N) [m] of the latter.
PUSHES_KEY, BEFORE_KEY = "pushes", "before"
MIN_FACTOR = -1.0  # Lower bound of a: back to the solution before.
MAX_FACTOR = 2.0  # Upper bound of a: twice the last step.


def as_pushes(loads: Loads) -> np.ndarray | None:
    """Return point [m], force [N] and footprint [m] of each load (B, 7); None unless a push is the only cause."""
    push = loads.get_only(Pushed)
    if push is None:
        return None
    return np.column_stack([push.point, push.force, push.footprint])


def compute_factors(push: np.ndarray, last_push: np.ndarray, previous_push: np.ndarray) -> np.ndarray:
    """Return the factors a (B,) of three successive pushes (B, 7); 0 without force, or if the last two are equal.

    Lengths are divided by the last footprint radius, forces by the last force.
    """
    forces = np.stack([push, last_push, previous_push])[:, :, 3:6]
    size = np.sqrt((forces * forces).sum(axis=2))
    unit = np.repeat(last_push[:, 6:], 7, axis=1)
    unit[:, 3:6] = size[1][:, None]
    unit[unit == 0.0] = 1.0
    way, further = (last_push - previous_push) / unit, (push - last_push) / unit
    square = (way * way).sum(axis=1)
    known = size.all(axis=0) & (square > 0.0)
    share = (further * way).sum(axis=1) / np.where(known, square, 1.0)
    return np.where(known, share.clip(MIN_FACTOR, MAX_FACTOR), 0.0)


def has_warm_state(warm: Mapping[str, Any], last_u: np.ndarray) -> bool:
    """Return True if the warm-start data contain finite values of the state before the solutions `last_u` (3N, B)."""
    if BEFORE_KEY not in warm or PUSHES_KEY not in warm:
        return False
    fits = warm[BEFORE_KEY].shape == last_u.T.shape and warm[PUSHES_KEY].shape == (last_u.shape[1], 2, 7)
    return fits and is_all_finite(warm[BEFORE_KEY]) and is_all_finite(warm[PUSHES_KEY])


def extrapolate_start(loads: Loads, last_u: np.ndarray, warm: Mapping[str, Any]) -> np.ndarray:
    """Return extrapolated starts (3N, B) [m], or the last solutions (3N, B) without data for an extrapolation."""
    now = as_pushes(loads)
    if now is None or not has_warm_state(warm, last_u):
        return last_u
    came, before = warm[PUSHES_KEY][:, 0], warm[PUSHES_KEY][:, 1]
    return last_u + compute_factors(now, came, before) * (last_u - warm[BEFORE_KEY].T)


def compute_directions(
    push: np.ndarray | None, last_u: np.ndarray | None, warm: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """Return the warm-start entries of solutions to pushes (B, 7) that started from the solutions `last_u` (3N, B)."""
    if push is None:
        return {}
    if last_u is None or PUSHES_KEY not in warm or warm[PUSHES_KEY].shape != (len(push), 2, 7):
        return {PUSHES_KEY: np.stack([push, push], axis=1)}
    return {PUSHES_KEY: np.stack([push, warm[PUSHES_KEY][:, 0]], axis=1), BEFORE_KEY: last_u.T}

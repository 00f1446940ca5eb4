"""Relaxation of tissue under a tool that a model follows, and the test whether its training covers that history.

FEM stores the decaying part of the stress, for each pair (g, tau) of a Prony series (`sim/terms/viscoelastic.py`). A
model stores the same for one number, the tool's depth d:
    h <- exp(-dt / tau) h + g exp(-dt / (2 tau)) (d - its last value).

The resistance to a change of shape has then lost the share r = sum_i (g_i - h_i / d), which all predictions depend on.
"""

from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Pushed
from sim.material import Pairs

from ..data.encode import split_forces
from ..data.load_histories import compute_decayed_coefficients

MEMORY_KEY = "relaxation"
"""Key in `Deformation.memory`: depth [m], position of first contact [m], then each h [m]; (B, 4 + pairs)."""
MAX_BACK_SHARE = 0.02  # Limit of the training: a tool moving back makes h negative by at most this share of g d.
MAX_SLIDE_SHARE = 0.5  # Limit of the training: a tool slides by at most this share of its footprint's radius.


@dataclass(frozen=True, eq=False)
class RelaxationState:
    """State of relaxation under B tools.

    Parameters
    ----------
    relaxed_share
        (B,): r, lost share of the resistance to a change of shape.
    outside_training
        (B,) bool: True if the history is outside the training.
    memory
        State for the next time step, in the layout of `MEMORY_KEY`.
    """

    relaxed_share: np.ndarray
    outside_training: np.ndarray
    memory: np.ndarray


def update_relaxation(
    series: Pairs, pushes: Pushed, times: np.ndarray, start: Deformation | None, min_depth: float
) -> RelaxationState:
    """Advance relaxation at indentations from the previous result; without one, assume `load_histories`.

    Parameters
    ----------
    pushes
        Indentations of B tools.
    times
        Times (B,) [s].
    start
        Result of a model of the same series, at earlier or the same times.
    min_depth
        Depth [m] below which tissue counts as free.

    Raises
    ------
    InputError
        A start without such a memory, or of later times.
    """
    depth, (g, tau) = split_forces(pushes)[0], np.array(series).T
    if start is None:
        left = compute_decayed_coefficients(series, times) * depth[:, None]
        return _compute_relaxed(g, pushes, depth, pushes.point, left, min_depth)
    past = start.memory.get(MEMORY_KEY)
    if past is None or past.shape != (len(depth), 4 + len(series)):
        raise InputError(
            "the start does not say how far the tissue has relaxed: start from this model's own result, or from none."
        )
    steps = times - start.time
    if (steps < 0.0).any():
        raise InputError(f"the start is {-steps.min():g} s later than the loads: times must not decrease.")
    half = np.exp(-steps[:, None] / (2.0 * tau))
    left = half * (half * past[:, 4:] + g * (depth - past[:, 0])[:, None])
    first = np.where((past[:, 0] > 0.0)[:, None], past[:, 1:4], pushes.point)
    return _compute_relaxed(g, pushes, depth, first, left, min_depth)


def _compute_relaxed(
    g: np.ndarray, pushed: Pushed, depth: np.ndarray, first: np.ndarray, left: np.ndarray, shallowest: float
) -> RelaxationState:
    """Compute the state from h (B, n) [m] of each pair, and the tools' positions of first contact (B, 3) [m]."""
    touching = depth > 0.0
    share = (g - left / np.where(touching, depth, 1.0)[:, None]).sum(axis=1)
    back = (left < -MAX_BACK_SHARE * g * np.maximum(depth, shallowest)[:, None]).any(axis=1)
    slid = np.linalg.norm(pushed.point - first, axis=1) > MAX_SLIDE_SHARE * pushed.footprint
    memory = np.column_stack([depth, first, left])
    return RelaxationState(np.clip(np.where(touching, share, 0.0), 0.0, g.sum()), back | (slid & touching), memory)

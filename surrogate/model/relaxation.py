"""Stress relaxation of tissue under a moving tool, and the test that the training covers the tool's history.

FEM stores the decaying part of the stress for each pair (g, tau) of a Prony series (`sim/terms/viscoelastic.py`). A
trained model stores the decaying part h of one number, the tool's depth d:
    h <- exp(-dt / tau) h + g exp(-dt / (2 tau)) (d - its last value).

The shear resistance has then lost the share r = sum_i (g_i - h_i / d), which is an input of all predictions.
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
"""Key in `Deformation.memory` of an array (B, 4 + pairs): depth [m], point of first contact [m], then each h [m]."""
MAX_BACK_SHARE = 0.02  # Limit of the training: a tool moving back makes h negative by at most this share of g d.
MAX_SLIDE_SHARE = 0.5  # Limit of the training: a tool slides by at most this share of its footprint's radius.


@dataclass(frozen=True, eq=False)
class RelaxationState:
    """State of relaxation under B tools, one tool per load case.

    Parameters
    ----------
    relaxed_share
        Lost share r of the shear resistance (B,).
    outside_training
        Mask (B,) of load cases with a tool history that the training does not cover.
    memory
        State for the next time step, in the layout of `MEMORY_KEY`.
    """

    relaxed_share: np.ndarray
    outside_training: np.ndarray
    memory: np.ndarray


def update_relaxation(
    series: Pairs, pushes: Pushed, times: np.ndarray, start: Deformation | None, min_depth: float
) -> RelaxationState:
    """Compute the relaxation at indentations, from the result `start` or else from a history as in `load_histories.py`.

    Parameters
    ----------
    pushes
        Indentations of B tools.
    times
        Times (B,) [s].
    start
        Previous result of a model with the same `series`, at the same or earlier times; None: no earlier result.
    min_depth
        Smallest depth [m] in the test for a tool that moves back.

    Raises
    ------
    InputError
        `start` has no relaxation state of this size, or is at a later time than the loads.
    """
    depth, (g, tau) = split_forces(pushes)[0], np.array(series).T
    if start is None:
        left = compute_decayed_coefficients(series, times) * depth[:, None]
        return _compute_state(g, pushes, depth, pushes.point, left, min_depth)
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
    return _compute_state(g, pushes, depth, first, left, min_depth)


def _compute_state(
    g: np.ndarray, pushes: Pushed, depth: np.ndarray, first_points: np.ndarray, history: np.ndarray, min_depth: float
) -> RelaxationState:
    """Compute the state from h (B, n) [m] of each Prony pair, and the points of first contact (B, 3) [m]."""
    touching = depth > 0.0
    share = (g - history / np.where(touching, depth, 1.0)[:, None]).sum(axis=1)
    back = (history < -MAX_BACK_SHARE * g * np.maximum(depth, min_depth)[:, None]).any(axis=1)
    slid = np.linalg.norm(pushes.point - first_points, axis=1) > MAX_SLIDE_SHARE * pushes.footprint
    memory = np.column_stack([depth, first_points, history])
    return RelaxationState(np.clip(np.where(touching, share, 0.0), 0.0, g.sum()), back | (slid & touching), memory)

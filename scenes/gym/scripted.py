"""Scripted policies of the tasks, based on observed states."""

from dataclasses import dataclass

import numpy as np

from .observation import LENGTH_UNIT
from .tasks import DEBULK, RETRACT, GymTask, find_task


@dataclass(frozen=True)
class PolicySettings:
    """Settings of `compute_scripted_actions`."""

    max_lateral_distance: float = 1.5e-3  # Lateral distance from the goal within which a tool goes down [m].
    # Force above which a tool is in contact [N]: three standard deviations of the measured force.
    min_contact_force: float = 6e-3
    stiffness: float = 60.0  # Stiffness of the tissue under a tool [N/m].
    # Motion of a blade relative to the required motion of the cortex, which is not observed under the blade.
    blade_motion_ratio: float = 1.0
    blade_ratio_increase: float = 2.0  # Increase of `blade_motion_ratio` during the longest episode.


def compute_scripted_actions(task: str, states: np.ndarray, settings: PolicySettings = PolicySettings()) -> np.ndarray:
    """Compute the actions (..., 6) float32 of the scripted policy for states (..., 24) of a task, given by name.

    Raises
    ------
    InputError
        No task has this name.
    """
    known = find_task(task)
    states = np.asarray(states, np.float64)
    place, goal, cortex = (LENGTH_UNIT * states[..., first : first + 3] for first in (0, 13, 21))
    off = goal - place
    force = np.linalg.norm(known.max_force * states[..., 9:12], axis=-1)
    asked, touches = known.unit * states[..., 19], force > settings.min_contact_force
    if known == DEBULK:
        off = off + cortex
        down = off[..., 2]
    elif known == RETRACT:
        direction = states[..., 16:19]
        ratio = settings.blade_motion_ratio + settings.blade_ratio_increase * states[..., 12]
        beyond = ratio * asked - np.einsum("...i,...i->...", -off, direction)
        off = np.where(touches[..., None], beyond[..., None] * direction, off)
        down = np.where(touches, off[..., 2], -known.step)
    else:
        down = np.where(touches, -(asked - force) / settings.stiffness, -0.6 * known.step)
    near = np.linalg.norm(off[..., :2], axis=-1) < settings.max_lateral_distance
    waits = ~near if known != RETRACT else ~near & ~touches
    off[..., 2] = np.where(waits, 0.0, down)
    return _build_action(known, off)


def _build_action(task: GymTask, translation: np.ndarray) -> np.ndarray:
    turn = np.zeros_like(translation)
    return np.clip(np.concatenate([translation / task.step, turn], axis=-1), -1.0, 1.0).astype(np.float32)

"""Scripted policy of each task, based on the robot's observations."""

from __future__ import annotations

import numpy as np

from .observation import LENGTH_UNIT
from .tasks import DEBULK, RETRACT, GymTask, find_task

MAX_LATERAL_DISTANCE = 1.5e-3  # Lateral distance from the goal within which a tool goes down [m].
MIN_CONTACT_FORCE = 6e-3  # Force above which a tool is in contact [N]: three standard deviations of the measured force.
STIFFNESS = 60.0  # Stiffness of the tissue under a tool [N/m].
BLADE_MOTION_RATIO = (
    1.0  # Motion of a blade relative to the required motion of the cortex, which is not observed under the blade.
)
BLADE_RATIO_INCREASE = 2.0  # Increase of the ratio BLADE_MOTION_RATIO during the longest episode.


def compute_scripted_actions(task: str, states: np.ndarray) -> np.ndarray:
    """Return actions (..., 6) float32 for states (..., 24) of a task by name.

    Raises
    ------
    InputError
        There is no such task.
    """
    known = find_task(task)
    states = np.asarray(states, np.float64)
    place, goal, cortex = (LENGTH_UNIT * states[..., first : first + 3] for first in (0, 13, 21))
    off = goal - place
    force = np.linalg.norm(known.force * states[..., 9:12], axis=-1)
    asked, touches = known.unit * states[..., 19], force > MIN_CONTACT_FORCE
    if known == DEBULK:
        off = off + cortex
        down = off[..., 2]
    elif known == RETRACT:
        direction = states[..., 16:19]
        beyond = (BLADE_MOTION_RATIO + BLADE_RATIO_INCREASE * states[..., 12]) * asked - np.einsum(
            "...i,...i->...", -off, direction
        )
        off = np.where(touches[..., None], beyond[..., None] * direction, off)
        down = np.where(touches, off[..., 2], -known.step)
    else:
        down = np.where(touches, -(asked - force) / STIFFNESS, -0.6 * known.step)
    near = np.linalg.norm(off[..., :2], axis=-1) < MAX_LATERAL_DISTANCE
    waits = ~near if known != RETRACT else ~near & ~touches
    off[..., 2] = np.where(waits, 0.0, down)
    return _build_action(known, off)


def _build_action(task: GymTask, way: np.ndarray) -> np.ndarray:
    turn = np.zeros_like(way)
    return np.clip(np.concatenate([way / task.step, turn], axis=-1), -1.0, 1.0).astype(np.float32)

"""Observations of the environments: tracked pose, measured force, planned goal, and images."""

import numpy as np
from gymnasium import spaces

from .tasks import Goal, GymTask
from .tool_motion import RobotTool

KINDS = ("states", "rgbd")
"""Kinds of observations."""
LENGTH_UNIT = 0.01
"""Unit of lengths in an observation [m]."""
TIME_UNIT = 10.0
"""Unit of times in an observation [s]: the longest episode."""
POSITION_NOISE = 1e-4  # Standard deviation of a tracked position [m].
FORCE_NOISE = 2e-3  # Standard deviation of a component of the measured force [N].
MOTION_NOISE = 2e-4  # Standard deviation of an observed motion of the cortex [m].
STATE_BOUND = 10.0
"""Limit to which the absolute values of an observation are clipped."""
STATE_SIZE = 24
"""Number of components of a state."""
MAX_DEPTH = 2.0
"""Upper limit of depths in images [m]."""


def build_action_space() -> spaces.Box:
    """Return the space of actions: twists (6,) of a tool in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (6,), np.float32)


def build_observation_space(observation_kind: str, size: tuple[int, int]) -> spaces.Space:
    """Return the observation space of a kind in `KINDS`; `size` is the width and height of images [pixel]."""
    states = spaces.Box(-STATE_BOUND, STATE_BOUND, (STATE_SIZE,), np.float32)
    if observation_kind == "states":
        return states
    width, height = size
    return spaces.Dict(
        {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0.0, MAX_DEPTH, (height, width), np.float32),
            "states": states,
        }
    )


def compute_states(
    task: GymTask, goal: Goal, robot_tool: RobotTool, readings: np.ndarray, time: float, progress: float,
    axes: np.ndarray, origin: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Compute the state (24,) float32 in the `axes` (3, 3) of twists, relative to the `origin` (3,) [m].

    Parameters
    ----------
    robot_tool
        Tracked pose of the tool.
    readings
        Measured force on the tissue [N] and motion of the open cortex [m], as rows (2, 3).
    time
        Time since the start of the episode [s].
    progress
        Completed share of the steps for which the goal must be kept, or of the parts to resect.
    """
    parts = (
        (robot_tool.position - origin) @ axes / LENGTH_UNIT,
        (axes.T @ robot_tool.rotation)[:, :2].T.ravel(),
        readings[0] @ axes / task.max_force,
        [time / TIME_UNIT],
        (goal.position - origin) @ axes / LENGTH_UNIT,
        goal.direction @ axes,
        [goal.amount / task.unit],
        [progress],
        readings[1] @ axes / LENGTH_UNIT,
    )
    return np.clip(np.concatenate(parts), -STATE_BOUND, STATE_BOUND).astype(np.float32)

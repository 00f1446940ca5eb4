"""Head poses as pure functions of time: direction of gravity and CSF level."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.bodies.fluid_level import compute_fluid_level
from sim.loads import Posture

from .tool_paths import smooth_step

SUPINE = (0.0, -1.0, 0.0)  # Direction of gravity for a patient lying supine (RAS).


@dataclass(frozen=True)
class HeadPose:
    """Head pose at one time: direction of gravity, and CSF level relative to the head size.

    Parameters
    ----------
    direction
        Direction of gravity (3,) in RAS coordinates, of any length > 0.
    fluid
        CSF level, measured against gravity: from 0 (completely drained) to 1 (above the highest vertex).
    """

    direction: tuple[float, float, float] = SUPINE
    fluid: float = 1.0

    def build_posture(self, nodes: np.ndarray) -> Posture:
        """Build the load of gravity and CSF for a mesh with nodes (V, 3) [m], as one load case."""
        down = np.array(self.direction) / np.linalg.norm(self.direction)
        return Posture(down[None], np.array([compute_fluid_level(nodes, down, self.fluid)]), np.ones(1))

    posture = build_posture  # Former names, for one release.


Lie = Callable[[float], HeadPose]
"""Function of time [s] that returns a head pose."""


def get_supine_pose(time: float) -> HeadPose:
    """Return the head pose of the scan at any time [s]: supine, completely covered by CSF."""
    return HeadPose()


def build_drainage(duration: float, level: float = 0.0) -> Lie:
    """Build a function of a supine pose whose CSF level falls to `level` (0 to 1) within `duration` [s]."""
    return lambda time: HeadPose(fluid=1.0 - (1.0 - level) * smooth_step(time / duration))


def build_drained_turn(drain_time: float, pause_time: float, turn_time: float, angle: float, level: float = 0.0) -> Lie:
    """Build a function of a pose: the CSF level falls to `level` in `drain_time`; after a pause, the head turns.

    The turn by `angle` [rad] takes `turn_time`; a positive angle lowers the left side. All times are in seconds.
    """
    falling = build_drainage(drain_time, level)

    def get_pose(time: float) -> HeadPose:
        turned = angle * smooth_step((time - drain_time - pause_time) / turn_time)
        return HeadPose((-float(np.sin(turned)), -float(np.cos(turned)), 0.0), falling(time).fluid)

    return get_pose

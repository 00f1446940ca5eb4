"""Head pose as pure functions of time: direction of gravity and fluid level."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.bodies.fluid_level import compute_fluid_level
from sim.loads import Posture

from .tool_paths import smooth_step

SUPINE = (0.0, -1.0, 0.0)  # Direction of gravity for a patient lying supine (RAS).


@dataclass(frozen=True)
class HeadPose:
    """Head pose at one time, independent of head size.

    Parameters
    ----------
    direction
        Direction of gravity (3,), in RAS, of any length > 0.
    fluid
        Fluid level against gravity: from 0, completely drained, to 1, above the highest vertex.
    """

    direction: tuple[float, float, float] = SUPINE
    fluid: float = 1.0

    def build_posture(self, nodes: np.ndarray) -> Posture:
        """Build the load case of a body with nodes (V, 3) [m]."""
        down = np.array(self.direction) / np.linalg.norm(self.direction)
        return Posture(down[None], np.array([compute_fluid_level(nodes, down, self.fluid)]), np.ones(1))

    posture = build_posture  # Former names, for one release.


Lie = Callable[[float], HeadPose]
"""Function of time [s] that returns a head pose."""


def get_supine_pose(time: float) -> HeadPose:
    """Return the pose of the scan, at any time [s]: supine, under fluid."""
    return HeadPose()


def build_drainage(duration: float, level: float = 0.0) -> Lie:
    """Return a supine pose whose fluid falls to a share of its height within `duration`."""
    return lambda time: HeadPose(fluid=1.0 - (1.0 - level) * smooth_step(time / duration))


def build_drained_turn(drain_time: float, pause_time: float, turn_time: float, angle: float, level: float = 0.0) -> Lie:
    """Build a pose: supine while fluid falls to a share `level`, a pause, then a turn by `angle` [rad]; times in s.

    A positive angle brings the left side down; the turn takes `turn_time` [s].
    """
    falling = build_drainage(drain_time, level)

    def lie(time: float) -> HeadPose:
        turned = angle * smooth_step((time - drain_time - pause_time) / turn_time)
        return HeadPose((-float(np.sin(turned)), -float(np.cos(turned)), 0.0), falling(time).fluid)

    return lie

"""A tool that twists move: where it is, and what stops it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..script.site import CraniotomyFrame
from ..script.tool import Instrument, Probe

HIGHEST = 0.02  # Largest height of a tool above the centre of the open cortex [m].


@dataclass(frozen=True, eq=False)
class RobotTool:
    """A tool in a robot's hand.

    Parameters
    ----------
    place
        Of the point about which it turns (3,) [m]: a ball's middle, or the middle of a blade's face.
    turned
        T_world_tool's rotation (3, 3).
    """

    place: np.ndarray
    turned: np.ndarray

    def compute_pose(self, tool: Instrument) -> np.ndarray:
        """T_world_tool (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.turned
        T[:3, 3] = self.place - compute_lever(tool) * self.turned[:, 2]
        return T


def compute_lever(tool: Instrument) -> float:
    """Return the distance of the pivot point up the tool's shaft [m]."""
    return tool.radius if isinstance(tool, Probe) else 0.0


def build_tool_frame(site: CraniotomyFrame) -> np.ndarray:
    """Return the frame of twists and observations, as columns (3, 3): the open cortex's right, up, and outwards."""
    return np.column_stack([site.right, site.up, -site.axis])


def lay_tool(site: CraniotomyFrame, tool: Instrument, tip: np.ndarray) -> RobotTool:
    """Return a tool in its first posture, its lowest point at `tip` (3,) [m]."""
    turned = tool.pose(tip, site.axis, site.right)[:3, :3]
    return RobotTool(tip - compute_lever(tool) * site.axis, turned)


def move_tool(
    hand: RobotTool, site: CraniotomyFrame, tool: Instrument, twist: np.ndarray, tilt: float, deepest: float
) -> RobotTool:
    """Return a tool after a twist (6,) [m, rad], in the frame of `build_tool_frame`, about its own point.

    The bone stops it at the opening's edge. It goes no deeper than `deepest` [m] below the open cortex's middle. It
    leans by no more than `tilt` [rad] from its first posture: a turn beyond that is left out.
    """
    frame = build_tool_frame(site)
    place = site.clip_to_opening(hand.place + frame @ twist[:3], tool.radius)
    along = float((place - site.origin) @ site.axis) + compute_lever(tool)
    place = place + (np.clip(along, -HIGHEST, deepest) - along) * site.axis
    turned = Rotation.from_rotvec(frame @ twist[3:]).as_matrix() @ hand.turned
    first = tool.pose(site.origin, site.axis, site.right)[:3, 2]
    if turned[:, 2] @ first < np.cos(tilt):
        turned = hand.turned
    return RobotTool(place, np.asarray(turned))


def shift_pose(hand: RobotTool, offset: np.ndarray) -> RobotTool:
    """Return the pose shifted by (3,) [m]."""
    return replace(hand, place=hand.place + offset)

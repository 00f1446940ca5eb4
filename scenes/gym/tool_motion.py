"""Tool moved by twists: its pose, and the limits of its motion."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.tool import Instrument, Probe

MAX_HEIGHT = 0.02  # Largest height of a tool above the centre of the open cortex [m].


@dataclass(frozen=True, eq=False)
class RobotTool:
    """Tool held by a robot.

    Parameters
    ----------
    place
        Position (3,) [m] of the point of rotation: centre of a ball, or centre of a blade's face.
    turned
        Rotation (3, 3) of T_world_tool.
    """

    place: np.ndarray
    turned: np.ndarray

    def compute_pose(self, tool: Instrument) -> np.ndarray:
        """Compute the pose T_world_tool (4, 4)."""
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
    """Return a tool in its initial orientation, with its lowest point at `tip` (3,) [m]."""
    turned = tool.pose(tip, site.axis, site.right)[:3, :3]
    return RobotTool(tip - compute_lever(tool) * site.axis, turned)


def move_tool(
    hand: RobotTool, site: CraniotomyFrame, tool: Instrument, twist: np.ndarray, tilt: float, deepest: float
) -> RobotTool:
    """Return a tool after a twist (6,) [m, rad], in the frame of `build_tool_frame`, about the pivot point.

    The bone limits its position at the opening's edge. Its depth below the open cortex's centre is at most `deepest`
    [m]. Its tilt from the first orientation is at most `tilt` [rad]: rotations beyond that are ignored.
    """
    frame = build_tool_frame(site)
    place = site.clip_to_opening(hand.place + frame @ twist[:3], tool.radius)
    along = float((place - site.origin) @ site.axis) + compute_lever(tool)
    place = place + (np.clip(along, -MAX_HEIGHT, deepest) - along) * site.axis
    turned = Rotation.from_rotvec(frame @ twist[3:]).as_matrix() @ hand.turned
    first = tool.pose(site.origin, site.axis, site.right)[:3, 2]
    if turned[:, 2] @ first < np.cos(tilt):
        turned = hand.turned
    return RobotTool(place, np.asarray(turned))


def shift_pose(hand: RobotTool, offset: np.ndarray) -> RobotTool:
    """Return a pose shifted by (3,) [m]."""
    return replace(hand, place=hand.place + offset)

"""Motion of a tool by twists, with its limits."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.tool import Instrument, Probe

MAX_HEIGHT = 0.02  # Largest height of a tool above the centre of the open cortex [m].


@dataclass(frozen=True, eq=False)
class RobotTool:
    """Pose of a tool that a robot moves.

    Parameters
    ----------
    position
        Position (3,) [m] of the pivot point: centre of a ball, or centre of a blade's face.
    rotation
        Rotation (3, 3) of T_world_tool.
    """

    position: np.ndarray
    rotation: np.ndarray

    def compute_pose(self, tool: Instrument) -> np.ndarray:
        """Compute the pose T_world_tool (4, 4) [m] of a tool at this position and rotation."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        T[:3, 3] = self.position - compute_pivot_distance(tool) * self.rotation[:, 2]
        return T


def compute_pivot_distance(tool: Instrument) -> float:
    """Return the distance [m] from the tool's lowest point to its pivot point."""
    return tool.radius if isinstance(tool, Probe) else 0.0


def build_tool_frame(site: CraniotomyFrame) -> np.ndarray:
    """Return the axes (3, 3) of twists and observations as columns: right, up and outwards at the open cortex."""
    return np.column_stack([site.right, site.up, -site.axis])


def place_tool(site: CraniotomyFrame, tool: Instrument, tip: np.ndarray) -> RobotTool:
    """Return the pose of a tool in its initial orientation, with its lowest point at `tip` (3,) [m]."""
    turned = tool.pose(tip, site.axis, site.right)[:3, :3]
    return RobotTool(tip - compute_pivot_distance(tool) * site.axis, turned)


def move_tool(
    robot_tool: RobotTool, site: CraniotomyFrame, tool: Instrument, twist: np.ndarray, max_tilt: float, max_depth: float
) -> RobotTool:
    """Return the pose after a twist (6,) [m, rad] about the pivot point, in the axes of `build_tool_frame`.

    The bone limits the position at the craniotomy's edge. The depth below the open cortex's centre is at most
    `max_depth` [m]. Rotations to a tilt above `max_tilt` [rad] from the initial orientation are ignored.
    """
    frame = build_tool_frame(site)
    place = site.clip_to_opening(robot_tool.position + frame @ twist[:3], tool.radius)
    along = float((place - site.origin) @ site.axis) + compute_pivot_distance(tool)
    place = place + (np.clip(along, -MAX_HEIGHT, max_depth) - along) * site.axis
    turned = Rotation.from_rotvec(frame @ twist[3:]).as_matrix() @ robot_tool.rotation
    first = tool.pose(site.origin, site.axis, site.right)[:3, 2]
    if turned[:, 2] @ first < np.cos(max_tilt):
        turned = robot_tool.rotation
    return RobotTool(place, np.asarray(turned))


def shift_pose(robot_tool: RobotTool, offset: np.ndarray) -> RobotTool:
    """Return the pose shifted by `offset` (3,) [m]."""
    return replace(robot_tool, position=robot_tool.position + offset)

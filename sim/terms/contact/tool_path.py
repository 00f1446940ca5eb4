"""How rigid tools get from one pose to another, and where one comes from that has not touched yet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...tools import Core, Tool, cores_of, distances_to, extent_of


@dataclass(frozen=True)
class Touch:
    """How finely a surface is looked at under tools, and how these come there.

    Parameters
    ----------
    sag
        Surfaces are looked at in points. Between them they are nearer to a tool by at most this share of the gap. It is
        added to the tool's radius, so that no point of a surface is inside.
    stretch
        Triangles may be stretched so many times before that may fail.
    stride
        A step moves no point of a tool farther into tissue than this share of its radius: none comes out at its other
        side.
    march
        Most steps of a tool's way through the air, each as far as nothing can be touched.
    kept
        Poses of which it is kept where their tools came from: a solver asks again and again.
    """

    sag: float = 0.25
    stretch: float = 1.3
    stride: float = 0.5
    march: int = 40
    kept: int = 4096


TOUCH = Touch()
"""Contact with tools as it is unless another is given."""


@dataclass(frozen=True, eq=False)
class Way:
    """B load cases' tools on their way: T_world_tool (B, tools, 4, 4) at its beginning and at its end."""

    begin: np.ndarray
    end: np.ndarray

    def at(self, share: np.ndarray) -> np.ndarray:
        """Poses (B, tools, 4, 4) after shares (B,) of the way: straight, turning evenly (spherical interpolation)."""
        count, tools = self.end.shape[:2]
        share = np.repeat(share, tools)
        before, after = self.begin.reshape(-1, 4, 4), self.end.reshape(-1, 4, 4)
        turn = Rotation.from_matrix(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3]).as_rotvec()
        out = after.copy()
        on_the_way = share != 1.0  # the end is reached to the last digit
        partly = Rotation.from_rotvec(share[:, None] * turn).as_matrix()
        out[on_the_way, :3, :3] = (before[:, :3, :3] @ partly)[on_the_way]
        moved = before[:, :3, 3] + share[:, None] * (after[:, :3, 3] - before[:, :3, 3])
        out[on_the_way, :3, 3] = moved[on_the_way]
        return out.reshape(count, tools, 4, 4)

    def travel(self, tools: tuple[Tool, ...]) -> np.ndarray:
        """How far (B, tools) [m] the points of each tool go, at most."""
        before, after = self.begin[:, :, :3], self.end[:, :, :3]
        turn = (before[..., :3].swapaxes(2, 3) @ after[..., :3]).reshape(-1, 3, 3)
        angle = Rotation.from_matrix(turn).magnitude().reshape(self.end.shape[:2])
        extent = np.array([extent_of(tool) for tool in tools])
        return np.linalg.norm(after[..., 3] - before[..., 3], axis=2) + angle * extent

    def stride(self, tools: tuple[Tool, ...], clear: np.ndarray, touch: Touch = TOUCH) -> np.ndarray:
        """The longest shares (B,), at most 1, of the way that tools may go at once that are `clear` (B, tools) [m]."""
        most = clear + touch.stride * np.array([min(core.radius for core in cores_of(tool)) for tool in tools])
        return (most / np.maximum(self.travel(tools), most)).min(axis=1)


def approach(
    tool: Tool, pose: np.ndarray, points: np.ndarray, reach: np.ndarray, march: int = Touch.march
) -> np.ndarray:
    """Where a tool at `pose` (4, 4) came from along its shaft: just clear of a surface with vertices `points` (n, 3).

    `reach` (n,) [m] is how far the surface goes on round each vertex. A tool that is clear where it is came from there.
    It is followed through the air in `march` steps at most.
    """
    out, shaft = pose.copy(), pose[:3, 2]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    back, room = max(_above(core, local, reach) for core in cores_of(tool)), 0.0
    for _ in range(march):
        back = max(0.0, back - room)
        out[:3, 3] = pose[:3, 3] + back * shaft
        room = max(0.0, float((distances_to(tool, out, points) - reach).min()))
    return out


def _above(core: Core, local: np.ndarray, reach: np.ndarray) -> float:
    """How high [m] above the tool's origin the surface goes, at most, where a core on its way down meets it."""
    aside = (np.abs(local[:, :2] - core.centre[:2]) - core.half[:2]).max(axis=1)
    return max(0.0, float((local[:, 2] + reach)[aside <= core.radius + reach].max(initial=0.0)))

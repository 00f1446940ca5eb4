"""Paths of rigid tools between poses, and contact-free start poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...tools import Core, Tool, compute_distances, compute_extent, list_cores


@dataclass(frozen=True)
class ContactSampling:
    """Options for sampling a surface under tools, and step limits of tool paths.

    Parameters
    ----------
    max_sag
        Maximum decrease of the distance to a tool between sample points of the surface, as a fraction of the gap. The
        tool radius is increased by this distance, so that no point of the surface is inside the tool.
    max_stretch
        Maximum stretch of triangles for which `max_sag` is guaranteed.
    max_stride
        Maximum motion of a tool into tissue per step, as a fraction of its radius, so that it cannot pass through
        the tissue surface.
    max_steps
        Maximum number of steps in the approach of a tool through air; each step is as long as the clearance.
    cached_poses
        Number of poses whose approach is cached, since a solver requests the same poses repeatedly.
    """

    max_sag: float = 0.25
    max_stretch: float = 1.3
    max_stride: float = 0.5
    max_steps: int = 40
    cached_poses: int = 4096


CONTACT_SAMPLING = ContactSampling()
"""Default sampling of tool contact."""


@dataclass(frozen=True, eq=False)
class ToolPath:
    """Tool paths of B load cases: T_world_tool poses (B, tools, 4, 4) at the start and at the end."""

    start_pose: np.ndarray
    end_pose: np.ndarray

    def interpolate(self, fraction: np.ndarray) -> np.ndarray:
        """Return poses (B, tools, 4, 4) at path fractions (B,), with spherical interpolation of rotations."""
        count, tools = self.end_pose.shape[:2]
        fraction = np.repeat(fraction, tools)
        before, after = self.start_pose.reshape(-1, 4, 4), self.end_pose.reshape(-1, 4, 4)
        turn = Rotation.from_matrix(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3]).as_rotvec()
        out = after.copy()
        on_the_way = fraction != 1.0  # the end pose is exact
        partly = Rotation.from_rotvec(fraction[:, None] * turn).as_matrix()
        out[on_the_way, :3, :3] = (before[:, :3, :3] @ partly)[on_the_way]
        moved = before[:, :3, 3] + fraction[:, None] * (after[:, :3, 3] - before[:, :3, 3])
        out[on_the_way, :3, 3] = moved[on_the_way]
        return out.reshape(count, tools, 4, 4)

    def measure_motion(self, tools: tuple[Tool, ...]) -> np.ndarray:
        """Return the maximum motion (B, tools) [m] of any point of each tool."""
        before, after = self.start_pose[:, :, :3], self.end_pose[:, :, :3]
        turn = (before[..., :3].swapaxes(2, 3) @ after[..., :3]).reshape(-1, 3, 3)
        angle = Rotation.from_matrix(turn).magnitude().reshape(self.end_pose.shape[:2])
        extent = np.array([compute_extent(tool) for tool in tools])
        return np.linalg.norm(after[..., 3] - before[..., 3], axis=2) + angle * extent

    def compute_stride(
        self, tools: tuple[Tool, ...], clearance: np.ndarray, sampling: ContactSampling = CONTACT_SAMPLING
    ) -> np.ndarray:
        """Return the path fraction (B,), at most 1, that tools with a `clearance` (B, tools) [m] may move at once."""
        radii = np.array([min(core.radius for core in list_cores(tool)) for tool in tools])
        most = clearance + sampling.max_stride * radii
        return (most / np.maximum(self.measure_motion(tools), most)).min(axis=1)


def find_approach(
    tool: Tool,
    pose: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    radii: np.ndarray,
    max_steps: int = ContactSampling.max_steps,
) -> np.ndarray:
    """Return the pose (4, 4), without contact, from which a tool moves straight to `pose` (4, 4).

    The motion is along the shaft, or along the outward surface normal if that path is less than half as long, since an
    instrument that is flat in tissue was not inserted sideways. A tool without contact at `pose` starts at `pose`. The
    surface has vertices `points` (n, 3) [m] with unit `normals` (n, 3), and extends to `radii` (n,) [m] around each
    vertex. The approach through air takes at most `max_steps` steps.
    """
    cores, R = list_cores(tool), pose[:3, :3]
    along_shaft = _find_clear_pose(tool, pose, R, cores, points, radii, max_steps)
    touched = compute_distances(tool, pose, points) < radii
    outward = normals[touched].sum(axis=0)
    if not outward.any():
        return along_shaft
    T = Rotation.align_vectors(outward[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    balls = [Core(T.T @ R @ core.centre, np.zeros(3), core.radius + float(np.linalg.norm(core.half))) for core in cores]
    along_normal = _find_clear_pose(tool, pose, T, balls, points, radii, max_steps)
    shaft, normal = (np.linalg.norm(start[:3, 3] - pose[:3, 3]) for start in (along_shaft, along_normal))
    return along_normal if 2.0 * normal < shaft else along_shaft


def _find_clear_pose(
    tool: Tool,
    pose: np.ndarray,
    R: np.ndarray,
    cores: Sequence[Core],
    points: np.ndarray,
    radii: np.ndarray,
    max_steps: int,
) -> np.ndarray:
    """Return the pose of `approach` along the third column of R (3, 3); `cores`, in the axes of R, contain the tool."""
    out, local = pose.copy(), (points - pose[:3, 3]) @ R
    back, room = max(_compute_clearing_distance(core, local, radii) for core in cores), 0.0
    for _ in range(max_steps):
        back = max(0.0, back - room)
        out[:3, 3] = pose[:3, 3] + back * R[:, 2]
        room = max(0.0, float((compute_distances(tool, out, points) - radii).min()))
    return out


def _compute_clearing_distance(core: Core, points: np.ndarray, radii: np.ndarray) -> float:
    """Return the distance [m] by which a core must rise along its z axis to clear every surface point on its path."""
    aside = (np.abs(points[:, :2] - core.centre[:2]) - core.half[:2]).max(axis=1)
    highest = (points[:, 2] + radii)[aside <= core.radius + radii].max(initial=-np.inf)
    return max(0.0, float(highest - (core.centre[2] - core.half[2] - core.radius)))

"""Sampling of a rigid tool's poses as in surgery: position, direction and depth."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.loads import Loads, Pushed, Touching
from sim.tools import Ball, BuiltIn, Capsule, Spatula, compute_distances, compute_extent, get_core

from .cortex_patch import Patch, build_barycentric_lattice, open_patch
from .tool_loads import TOOLS, build_rotations_about, draw, find_perpendiculars, interpolate_range, sample_pushes

BALL_PRESETS = ("palpation", "bipolar", "dissector")  # Presets that a ball can represent.


@dataclass(frozen=True)
class ToolPoseSettings:
    """Settings of `draw_poses`."""

    min_depth_ratio: float = 0.05  # Smallest depth as a share of the tool's radius.
    # Largest depth of a ball as a share of its radius; a deeper ball, which has no shaft, would be covered by tissue.
    max_ball_depth: float = 0.9
    max_rod_depth: float = 2.0  # Largest depth of a rod [radii].
    max_blade_depth: float = 2.0 / 3.0  # Largest depth of a blade [widths].
    max_blade_tilt: float = np.radians(20.0)  # Largest tilt of a blade [rad].
    contact_tolerance: float = 1e-6  # Distance that counts as contact when a tool is lowered [m].
    max_steps: int = 200  # Maximum number of steps when a tool is lowered.
    sample_rows: int = 4  # Subdivisions of a triangle's edges for surface sample points when a tool is lowered.
    min_search_radius: float = 10e-3  # Lower bound of a third of the search radius round the tool [m].


def choose_ball(preset: str) -> Ball:
    """Return the ball that represents a round tool: its radius is the mean of the preset's smallest and largest.

    Raises
    ------
    InputError
        The preset is not a round tool.
    """
    if preset not in BALL_PRESETS:
        raise InputError(
            f"no ball stands for the preset {preset}: choose one of {', '.join(BALL_PRESETS)}, or give --blade or "
            "--capsule."
        )
    return Ball(0.5 * sum(TOOLS[preset].radius_range))


def draw_poses(
    preset: str, anatomy: Anatomy, count: int, seed: int, tool: BuiltIn | None = None,
    settings: ToolPoseSettings = ToolPoseSettings(),
) -> Loads:  # fmt: skip
    """Sample `count` poses of a tool that presses on the open cortex; pose i does not depend on `count`, as in `draw`.

    Positions are uniform by area, with the tool's end inside the craniotomy's edge. A ball has the positions and
    directions of the preset's forces; its depth is uniform from 0.05 to 0.9 of its radius, limited to the preset's
    depth. Rods and blades move straight along their shaft from the first contact, with a random rotation about it. Rods
    tilt as the preset's tool, with depths of up to two radii. Blades tilt by up to 20 degrees, with depths of up to two
    thirds of their width.

    Parameters
    ----------
    tool
        Tool; None: the ball that represents the preset.

    Raises
    ------
    InputError
        See `draw` and `choose_ball`.
    """
    tool, patch = choose_ball(preset) if tool is None else tool, open_patch(anatomy)
    source = np.random.Generator(np.random.Philox(key=seed))
    if isinstance(tool, Ball):
        (pushed,) = draw(preset, anatomy, count, seed).get_all(Pushed)
        direction = pushed.force / np.linalg.norm(pushed.force, axis=1, keepdims=True)
        deepest = min(settings.max_ball_depth * tool.radius, TOOLS[preset].max_depth)
        depth = interpolate_range((settings.min_depth_ratio * tool.radius, deepest), source.random(count))
        return Loads((compute_poses(tool, pushed.point, patch.find_normals(pushed.point), depth[:, None] * direction),))
    if isinstance(tool, Capsule):
        room, deepest, cone = tool.radius, settings.max_rod_depth * tool.radius, TOOLS[preset].max_angle
    else:
        room, deepest, cone = compute_extent(tool), settings.max_blade_depth * tool.width, settings.max_blade_tilt
    kind = replace(TOOLS[preset], name=type(tool).__name__, radius_range=(room, room), max_angle=cone)
    point, direction = sample_pushes(kind, patch, count, seed)
    share = source.random((count, 2))
    shallowest = settings.min_depth_ratio * get_core(tool).radius
    depth = interpolate_range((shallowest, min(deepest, TOOLS[preset].max_depth)), share[:, 0])
    rotation = _build_rotations(-direction, 2.0 * np.pi * share[:, 1])
    return Loads((_move_to_contact(tool, patch, point, rotation, depth, settings),))


def compute_poses(ball: Ball, point: np.ndarray, normal: np.ndarray, motion: np.ndarray) -> Touching:
    """Compute a ball's poses: `motion` (B, 3) from first contact at `point` (B, 3) [m] with inward `normal` (B, 3)."""
    shaft = -motion / np.linalg.norm(motion, axis=1, keepdims=True)
    pose = np.zeros((len(point), 1, 4, 4))
    pose[:, 0, 3, 3] = 1.0
    pose[:, 0, :3, 3] = point + motion - ball.radius * (normal + shaft)
    pose[:, 0, :3, :3] = build_rotations_about(shaft)
    return Touching(pose)


def _build_rotations(shaft: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Build rotations (B, 3, 3) with z axis `shaft` (B, 3), turned about this axis by `angle` (B,) [rad]."""
    first, second = find_perpendiculars(shaft)
    x = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return np.stack([x, np.cross(shaft, x), shaft], axis=2)


def _move_to_contact(
    tool: Capsule | Spatula, patch: Patch, point: np.ndarray, rotation: np.ndarray, depth: np.ndarray,
    settings: ToolPoseSettings,
) -> Touching:  # fmt: skip
    """Lower a tool along its shaft towards `point` (B, 3) until contact, then by `depth` (B,) [m]; return the poses.

    Each step is the distance to the nearest point of the surface (Hart 1996, "Sphere tracing", Visual Comput.
    12:527-545). The surface is sampled by `ToolPoseSettings.sample_rows`^2 points a triangle.
    """
    share = build_barycentric_lattice(settings.sample_rows)
    surface = np.einsum("qc,scx->sqx", share, patch.points[patch.triangles]).reshape(-1, 3)
    reach, tree = compute_extent(tool), KDTree(surface)
    pose = np.tile(np.eye(4), (len(point), 1, 1, 1))
    pose[:, 0, :3, :3] = rotation
    for here, start, shaft, deep in zip(pose[:, 0], point, rotation[:, :, 2], depth, strict=True):
        near = surface[tree.query_ball_point(start, 3.0 * max(reach, settings.min_search_radius))]
        here[:3, 3] = start + reach * shaft
        for _ in range(settings.max_steps):
            room = float(compute_distances(tool, here, near).min())
            if room < settings.contact_tolerance:
                break
            here[:3, 3] -= room * shaft
        here[:3, 3] -= deep * shaft
    return Touching(pose)

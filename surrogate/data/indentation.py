"""Conversion of a rigid tool's poses to pushes: a point on the undeformed cortex, and a depth.

A tool's pose is tracked, its force is not measured. Without friction the deformation depends on the tool's pose, not on
its path. Regressors use depth instead of force, as both are zero if nothing moves.
"""

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Loads, Pushed, Retracted, Touching
from sim.tools import Ball, BuiltIn, Capsule, Core, compute_extent, get_core, name_tool

from .cortex_patch import Patch
from .tool_loads import build_rotations_about

SURFACE_TOLERANCE = 1e-6  # Distance of a point from the surface below which the surface's normal is used [m].
SAMPLE_SPACING = 1.0  # Maximum spacing of a core's sample points [radii].
MAX_ROD_SAMPLES = 6  # Number of samples along a rod from its end.


@dataclass(frozen=True, eq=False)
class IndentationPushes(Pushed):
    """Indentations by a rod or a blade, which also depend on the tool's orientation.

    `axes` (B, 3, 3) has the tool's axes as columns. `offset` (B, 3) [m] points from the indented point, `point` +
    `force`, to the centre of the tool's core. `footprint` is the radius of the rod, or of a ball round the blade.
    """

    axes: np.ndarray
    offset: np.ndarray


@dataclass(frozen=True, eq=False)
class RelaxingPushes(Pushed):
    """Indentations of tissue that has lost the share `relaxed` (B,) of its shear resistance."""

    relaxed: np.ndarray


@dataclass(frozen=True, eq=False)
class RelaxingIndentationPushes(IndentationPushes):
    """Indentations of relaxing tissue by a rod or a blade."""

    relaxed: np.ndarray


def add_relaxation(pushes: Pushed, relaxed_share: np.ndarray) -> Pushed:
    """Return the same indentations in tissue that has relaxed by the shares `relaxed_share` (B,)."""
    kind = RelaxingIndentationPushes if isinstance(pushes, IndentationPushes) else RelaxingPushes
    return kind(**vars(pushes), relaxed=relaxed_share)


def get_relaxation(pushes: Pushed) -> np.ndarray | None:
    """Return the relaxed shares (B,) of the tissue; None if the tissue does not relax."""
    return pushes.relaxed if isinstance(pushes, RelaxingPushes | RelaxingIndentationPushes) else None


def get_poses(loads: Loads, tool: BuiltIn) -> np.ndarray:
    """Return poses T_world_tool (B, 4, 4) from `Touching` loads of a single tool, or `Retracted` loads of a blade.

    Raises
    ------
    InputError
        The loads have other causes, or several tools.
    """
    touching, retracted = loads.get_only(Touching), loads.get_only(Retracted)
    if touching is not None and touching.pose.shape[1] == 1:
        return touching.pose[:, 0]
    if retracted is None:
        names = ", ".join(type(cause).__name__ for cause in loads.causes) or "none"
        raise InputError(
            f"the loads have the causes {names}, but this model was trained on the poses of {name_tool(tool)}: give "
            "`Touching` of one tool alone, or ask the finite elements."
        )
    pose = retracted.pose.copy()
    pose[:, :3, 3] += retracted.displacement
    return pose


def to_indentation(loads: Loads, tool: BuiltIn, patch: Patch) -> Pushed:
    """Convert one tool's poses to pushes: nearest point (B, 3) [m], normal depth as force [m], radius.

    The point is nearest to the foot: the centre of a ball, or of a rod's or blade's lower end. Depth 0: no contact.

    Raises
    ------
    InputError
        The loads are not the poses of one tool.
    """
    pose, core = get_poses(loads, tool), get_core(tool)
    foot = pose[:, :3, 3] + pose[:, :3, :3] @ (core.centre - [0.0, 0.0, core.half[2]])
    at = np.einsum("bij,kj->bki", pose[:, :3, :3], _sample_tool_core(core)) + pose[:, None, :3, 3]
    near, off = _compute_signed_distances(patch, np.concatenate([foot, at.reshape(-1, 3)]))
    point, distance = near[: len(pose)], off[: len(pose)]
    inward = patch.find_normals(point)
    on_it = np.abs(distance) < SURFACE_TOLERANCE
    direction = np.where(on_it[:, None], inward, (point - foot) / np.where(on_it, 1.0, distance)[:, None])
    if isinstance(tool, Ball):
        depth = np.maximum(core.radius - distance, 0.0)
        return Pushed(point, depth[:, None] * direction, np.full(len(pose), core.radius))
    deepest = core.radius - off[len(pose) :].reshape(len(pose), -1).min(axis=1)
    force = np.maximum(deepest, 0.0)[:, None] * direction
    axes = pose[:, :3, :3]
    if isinstance(tool, Capsule):  # a rod is round: its turn about the shaft does not matter
        axes = build_rotations_about(axes[:, :, 2])
    middle = pose[:, :3, 3] + pose[:, :3, :3] @ core.centre
    wide = np.full(len(pose), core.radius if isinstance(tool, Capsule) else compute_extent(tool))
    return IndentationPushes(point, force, wide, axes, middle - point - force)


def _compute_signed_distances(patch: Patch, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) of the undeformed cortex nearest to `points` (n, 3), and signed distances (n,) [m]."""
    near = patch.contact_surface.find_nearest(points, np.full(len(points), np.inf))[0]
    away = near - points
    return near, np.copysign(np.linalg.norm(away, axis=1), np.einsum("bi,bi->b", away, patch.find_normals(near)))


def _sample_tool_core(core: Core) -> np.ndarray:
    """Sample points (k, 3) [m] of a core and its border, in the tool's frame; of a rod, only near its lower end."""
    steps = np.ceil(2.0 * core.half / (SAMPLE_SPACING * core.radius)).astype(int)
    low, high = core.centre - core.half, core.centre + core.half
    if steps[2] > MAX_ROD_SAMPLES:
        steps[2], high[2] = MAX_ROD_SAMPLES, low[2] + MAX_ROD_SAMPLES * SAMPLE_SPACING * core.radius
    axes = [np.linspace(first, last, count + 1) for first, last, count in zip(low, high, steps, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def get_only_pushes(loads: Loads) -> Pushed:
    """Return the `Pushed` loads, if the loads have no other cause.

    Raises
    ------
    InputError
        The loads have another cause.
    """
    pushed = loads.get_only(Pushed)
    if pushed is None:
        names = ", ".join(type(cause).__name__ for cause in loads.causes) or "none"
        raise InputError(
            f"the loads have the causes {names}, but this model was trained on pushing forces only: give `Pushed` "
            "alone, or ask the finite elements."
        )
    return pushed

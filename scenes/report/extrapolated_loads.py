"""Loads beyond the training range: what extrapolation costs is measured on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim.loads import Loads, Pushed
from surrogate.data.cortex_patch import Patch
from surrogate.data.encode import directions

# Times the greatest force; degrees more than the greatest angle; of the radius, how near to the rim a centre comes.
STRONGER, MORE_OBLIQUE, NEARER = (1.2, 1.6), (5.0, 15.0), (0.5, 0.9)
KINDS = ("stronger", "more oblique", "nearer to the rim")


def loads_beyond(patch: Patch, training: Pushed, like: Pushed, count: int) -> Loads:
    """`count` loads, every third of one of `KINDS`, otherwise as those of `like` are; always the same ones."""
    random = np.random.default_rng(0)
    rows = random.integers(len(like.point), size=count)
    kind = np.arange(count) % len(KINDS)
    size, direction = directions(replace(like, force=like.force[rows]))
    point, footprint = like.point[rows], like.footprint[rows]
    size = np.where(kind == 0, directions(training)[0].max() * random.uniform(*STRONGER, count), size)
    oblique = _tilted(
        direction, patch.normal_near(point), _angle(patch, training), random.uniform(*MORE_OBLIQUE, count)
    )
    direction = np.where((kind == 1)[:, None], oblique, direction)
    point = np.where((kind == 2)[:, None], _near_rim(patch, footprint, random), point)
    return Loads((Pushed(point, size[:, None] * direction, footprint),))


def _angle(patch: Patch, pushed: Pushed) -> float:
    """Greatest angle between force and inward normal [rad]."""
    cosine = np.einsum("bi,bi->b", directions(pushed)[1], patch.normal_near(pushed.point))
    return float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))


def _tilted(direction: np.ndarray, normal: np.ndarray, angle: float, more: np.ndarray) -> np.ndarray:
    """Unit directions (B, 3) turned off `normal` (B, 3) by `angle` [rad] and `more` (B,) [degrees], at most 85."""
    along = direction - np.einsum("bi,bi->b", direction, normal)[:, None] * normal
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    along = np.where(length > 1e-9, along / np.maximum(length, 1e-9), across / np.linalg.norm(across, axis=1)[:, None])
    turn = np.minimum(angle + np.radians(more), np.radians(85.0))[:, None]
    return np.cos(turn) * normal + np.sin(turn) * along


def _near_rim(patch: Patch, footprint: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Points (B, 3) [m] whose footprints (B,) [m] hang over the rim by a tenth to half of their radius."""
    points = patch.place(random.random((4096, 3)))[0]
    ratio = patch.rim_distance(points)[None] / footprint[:, None]
    wanted = random.uniform(*NEARER, len(footprint))[:, None]
    return points[np.abs(ratio - wanted).argmin(axis=1)]

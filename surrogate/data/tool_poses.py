"""Poses of a rigid ball as surgery makes them: where it touches, in which direction, how deep."""

from __future__ import annotations

import numpy as np

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.loads import Loads, Pushed, Touching
from sim.tools import Ball

from .cortex_patch import open_patch
from .tool_loads import TOOLS, across, draw

# What a ball may stand for.
ROUND = ("palpation", "bipolar", "dissector")
# Depths as shares of the radius: a deeper ball would be swallowed, having no shaft.
SHALLOW, DEEP = 0.05, 0.9


def ball_of(preset: str, radius: float | None = None) -> Ball:
    """The ball that stands for a round tool: of a radius [m], or of the middle of the tool's own.

    Raises
    ------
    InputError
        A preset that is not one round tool, or a radius that is not positive.
    """
    if preset not in ROUND:
        raise InputError(f"no ball stands for the preset {preset}: choose one of {', '.join(ROUND)}.")
    return Ball(0.5 * sum(TOOLS[preset].footprint) if radius is None else radius)


def draw_poses(preset: str, anatomy: Anatomy, count: int, seed: int, radius: float | None = None) -> Loads:
    """Draw `count` poses of the preset's ball, pressed into the open cortex; load i depends as in `surrogate.draw`.

    Places and directions are those of the preset's forces: uniform by area, its footprint inside the rim, within the
    tool's cone. Depths are uniform from 0.05 to 0.9 of the radius, and no deeper than the tool goes.

    Raises
    ------
    InputError
        As `draw` and `ball_of`.
    """
    ball, patch = ball_of(preset, radius), open_patch(anatomy)
    (pushed,) = draw(preset, anatomy, count, seed).every(Pushed)
    deepest = min(DEEP * ball.radius, TOOLS[preset].depth)
    share = np.random.Generator(np.random.Philox(key=seed)).random(count)
    depth = SHALLOW * ball.radius + (deepest - SHALLOW * ball.radius) * share
    direction = pushed.force / np.linalg.norm(pushed.force, axis=1, keepdims=True)
    return Loads((poses_at(ball, pushed.point, patch.normal_near(pushed.point), depth[:, None] * direction),))


def poses_at(ball: Ball, point: np.ndarray, normal: np.ndarray, motion: np.ndarray) -> Touching:
    """Poses of a ball that touches first at point (B, 3) [m], of inward normal (B, 3), and goes on by motion (B, 3)."""
    shaft = -motion / np.linalg.norm(motion, axis=1, keepdims=True)
    pose = np.zeros((len(point), 1, 4, 4))
    pose[:, 0, 3, 3] = 1.0
    pose[:, 0, :3, 3] = point + motion - ball.radius * (normal + shaft)
    pose[:, 0, :3, :3] = np.stack([*across(shaft), shaft], axis=2)
    return Touching(pose)

"""Poses of a ball as pushes: where it first touches the open cortex on its way along its shaft, and how far it goes on.

A tool's pose is tracked where its force is not known. To learners a depth along a direction is what a force is: both
are nothing where nothing moves.
"""

from __future__ import annotations

import numpy as np

from sim.errors import InputError
from sim.loads import Loads, Pushed, Touching

from .patch import Patch

# Swept against the patch together.
BLOCK = 64
# How far beside a triangle a contact still counts as its own, as a share of its size: round-off tears no holes.
SLACK = 1e-9


def indented(loads: Loads, radius: float, patch: Patch) -> Pushed:
    """One ball's poses as pushes: point (B, 3) [m] of first touch, depth times direction for force [m], its radius.

    A ball that touches nothing has no depth; its point is the patch's nearest node.

    Raises
    ------
    InputError
        Loads that are not the poses of one tool.
    """
    touching = loads.only(Touching)
    if touching is None or touching.pose.shape[1] != 1:
        names = ", ".join(type(cause).__name__ for cause in loads.causes) or "none"
        raise InputError(
            f"the loads have the causes {names}, but this model was taught the poses of one ball: give `Touching` of "
            "one tool alone, or ask the finite elements."
        )
    pose = touching.pose[:, 0]
    shaft = pose[:, :3, 2]
    middle = pose[:, :3, 3] + radius * shaft
    parts = [slice(first, first + BLOCK) for first in range(0, len(pose), BLOCK)]
    found = [_first_touch(middle[part], shaft[part], radius, patch) for part in parts]
    depth, point = (np.concatenate(column) for column in zip(*found, strict=True))
    return Pushed(point, -np.maximum(depth, 0.0)[:, None] * shaft, np.full(len(pose), radius))


def _first_touch(middle: np.ndarray, shaft: np.ndarray, radius: float, patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """How far (B,) [m] balls at `middle` (B, 3) went on since they touched, along minus `shaft` (B, 3); where (B, 3).

    Exactly: against faces, edges and corners, each as far back as a ball touches it. Not touched: minus infinity.
    """
    corner = patch.points[patch.triangles]
    edge = np.roll(corner, -1, axis=1) - corner
    tried = [
        _faces(middle, shaft, radius, corner, edge),
        _edges(middle, shaft, radius, corner.reshape(-1, 3), edge.reshape(-1, 3)),
        _corners(middle, shaft, radius, patch.points),
    ]
    back = np.concatenate([part[0] for part in tried], axis=1)
    last = back.argmax(axis=1)
    rows = np.arange(len(middle))
    where = np.concatenate([part[1] for part in tried], axis=1)[rows, last]
    depth = back[rows, last]
    missed = np.isneginf(depth)
    if missed.any():
        where[missed] = patch.points[np.linalg.norm(middle[missed, None] - patch.points, axis=2).argmin(axis=1)]
    return depth, where


def _faces(
    middle: np.ndarray, shaft: np.ndarray, radius: float, corner: np.ndarray, edge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    normal = np.cross(edge[:, 0], edge[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = shaft @ normal.T
    height = np.einsum("bsi,si->bs", middle[:, None] - corner[:, 0], normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = (radius - height) / along
        where = middle[:, None] + back[..., None] * shaft[:, None] - radius * normal
        # Inward normals of the edges, in the plane: inside of all three.
        aside = np.einsum("bscx,scx->bsc", where[:, :, None] - corner, np.cross(normal[:, None], edge))
        inside = (aside >= -SLACK * np.einsum("scx,scx->sc", edge, edge)).all(axis=2) & (along > 0.0)
    return np.where(inside, back, -np.inf), where


def _edges(
    middle: np.ndarray, shaft: np.ndarray, radius: float, start: np.ndarray, edge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    length = np.einsum("ei,ei->e", edge, edge)
    offset = middle[:, None] - start
    at, rate = np.einsum("bei,ei->be", offset, edge) / length, shaft @ edge.T / length
    across, moving = offset - at[..., None] * edge, shaft[:, None] - rate[..., None] * edge
    back = _larger_root(moving, across, radius)
    with np.errstate(invalid="ignore"):  # what is never touched
        share = at + back * rate
        where = start + share[..., None] * edge
        inside = (share >= 0.0) & (share <= 1.0)
    return np.where(inside, back, -np.inf), where


def _corners(middle: np.ndarray, shaft: np.ndarray, radius: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    offset = middle[:, None] - points
    back = _larger_root(np.broadcast_to(shaft[:, None], offset.shape), offset, radius)
    return back, np.broadcast_to(points, offset.shape)


def _larger_root(moving: np.ndarray, offset: np.ndarray, radius: float) -> np.ndarray:
    """The largest t (B, n) with |offset + t moving| = radius, minus infinity where there is none."""
    a = np.einsum("bni,bni->bn", moving, moving)
    b = np.einsum("bni,bni->bn", moving, offset)
    c = np.einsum("bni,bni->bn", offset, offset) - radius**2
    inner = b * b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((inner >= 0.0) & (a > 0.0), (-b + np.sqrt(np.maximum(inner, 0.0))) / a, -np.inf)

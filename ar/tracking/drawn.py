"""Pictures of printed targets as a camera would take them: for trials with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..camera import Camera
from .targets import BORDER, Face, Target

# Texture pixels along a square, and how many samples of the picture lie along a pixel.
TEXTURE, SAMPLES = 48, 4
# What paper reflects: black ink, white paper.
INK, PAPER = 25.0, 225.0


def drawn(picture: np.ndarray, camera: Camera, targets: Sequence[tuple[Target, np.ndarray]]) -> np.ndarray:
    """A picture (H, W) uint8 with targets before it, seen sharply and evenly lit.

    Every pixel is the mean of `SAMPLES`^2 rays, each followed through the lens to the face that it meets first.

    Parameters
    ----------
    picture
        What lies behind.
    camera
        Where it stands in the world.
    targets
        With T_world_target (4, 4) each.
    """
    out, nearest = np.repeat(picture[None].astype(np.float32), SAMPLES**2, axis=0), {}
    for target, T_world_target in targets:
        for face in target.faces:
            T = camera.T_camera_world @ T_world_target @ face.T_target_face
            where = _window(camera, face, T) if T[:3, 2] @ T[:3, 3] > 0.0 else None  # not if seen from behind
            if where is None:
                continue
            printed = face.picture(TEXTURE)
            for sample, shift in enumerate(_shifts()):
                deep = nearest.setdefault(sample, np.full(picture.shape, np.inf))
                columns, rows = (np.arange(part.start, part.stop) for part in where[::-1])
                rays = _rays(camera, np.stack(np.meshgrid(columns + shift[0], rows + shift[1]), axis=-1))
                depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
                grey = _grey(face, printed, (rays * depth[..., None] - T[:3, 3]) @ T[:3, :2])
                front = ~np.isnan(grey) & (depth > 0.0) & (depth < deep[where])
                out[sample][where] = np.where(front, grey, out[sample][where])
                deep[where] = np.where(front, depth, deep[where])
    return np.clip(np.rint(out.mean(axis=0)), 0.0, 255.0).astype(np.uint8)


def _shifts() -> np.ndarray:
    """Where the samples of a pixel lie (n, 2), from its centre."""
    middles = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    return np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Directions (..., 3) in the camera frame of pixels (..., 2), at depth 1."""
    world = camera.unproject(pixels, np.ones(pixels.shape[:-1]))
    return camera.in_frame(world)


def _window(camera: Camera, face: Face, T_camera_face: np.ndarray) -> tuple[slice, slice] | None:
    """Rows and columns that a face may cover, a border of pixels round it; None: it is out of view."""
    corners = (np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (0.5 * face.size + BORDER)) + (
        0.5 * face.size
    )
    edge = np.concatenate([np.linspace(a, b, 9) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    points = np.column_stack([edge, np.zeros(len(edge))]) @ T_camera_face[:3, :3].T + T_camera_face[:3, 3]
    world = (points - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
    seen = camera.project(world)[0]
    seen = seen[~np.isnan(seen).any(axis=1)]
    if not len(seen):
        return None
    low = np.floor(seen.min(axis=0)).astype(int) - 2
    high = np.ceil(seen.max(axis=0)).astype(int) + 3
    left, top = np.clip(low, 0, [camera.width, camera.height])
    right, bottom = np.clip(high, 0, [camera.width, camera.height])
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def _grey(face: Face, printed: np.ndarray, on_face: np.ndarray) -> np.ndarray:
    """Grey values (...) at places (..., 2) [m] of a face that was `printed`, NaN off its border."""
    pixels = (on_face * (TEXTURE / face.square) - 0.5).astype(np.float32)
    paper = cv2.remap(
        printed,
        pixels[..., 0],
        pixels[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=255.0,
    )
    inside = ((on_face >= -BORDER) & (on_face <= face.size + BORDER)).all(axis=-1)
    return np.where(inside, INK + (PAPER - INK) / 255.0 * paper, np.nan)

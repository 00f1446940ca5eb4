"""Pictures of printed targets as a camera would take them: for trials with known poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ..camera import Camera
from .detection import window_round
from .targets import BORDER, Face, Target

# Texture pixels along a square, and how many samples of the picture lie along a pixel.
TEXTURE, SAMPLES = 48, 4
# Pixels round a face that are looked at: its edges are straight without a lens only.
MARGIN = 3.0
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
    own = replace(camera, T_camera_world=np.eye(4))
    out = np.repeat(picture[None].astype(np.float32), SAMPLES**2, axis=0)
    nearest = np.full(out.shape, np.inf)
    for target, T_world_target in targets:
        for face in target.faces:
            T = camera.T_camera_world @ T_world_target @ face.T_target_face
            where = window_round(own, _edge(face) @ T[:3, :3].T + T[:3, 3], 0.0, MARGIN)
            if where is None or T[:3, 2] @ T[:3, 3] <= 0.0:  # or seen from behind
                continue
            printed = face.picture(TEXTURE)
            for sample, shift in enumerate(_shifts()):
                columns, rows = (np.arange(part.start, part.stop) for part in where[::-1])
                pixels = np.stack(np.meshgrid(columns + shift[0], rows + shift[1]), axis=-1)
                rays = own.unproject(pixels, np.ones(pixels.shape[:-1]))
                depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
                grey = _grey(face, printed, (rays * depth[..., None] - T[:3, 3]) @ T[:3, :2])
                front = ~np.isnan(grey) & (depth > 0.0) & (depth < nearest[sample][where])
                out[sample][where] = np.where(front, grey, out[sample][where])
                nearest[sample][where] = np.where(front, depth, nearest[sample][where])
    return np.clip(np.rint(out.mean(axis=0)), 0.0, 255.0).astype(np.uint8)


def _shifts() -> np.ndarray:
    """Where the samples of a pixel lie (n, 2), from its centre."""
    middles = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    return np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)


def _edge(face: Face) -> np.ndarray:
    """Places (n, 3) [m] along the edge of a face's border, in its own frame."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (0.5 * face.size + BORDER)
    edge = np.concatenate([np.linspace(a, b, 9) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    return np.column_stack([edge + 0.5 * face.size, np.zeros(len(edge))])


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

"""Outlines of what a camera sees: where they are in the picture, and how they are drawn on a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.rasteriser import seen
from .window import DARK, NEAR_EDGE, SURROUND

# Of a sheet's fourth channel, where a line covers what is under it.
OPAQUE = 255
# Pixels from one to the next that is looked at first, where a lens bends what lies between points.
COARSE = 16


def ink_of(colour: np.ndarray | tuple[float, float, float]) -> tuple[float, float, float]:
    """The mean of colours (3,) or (V, 3), sRGB in [0, 1], as lines are drawn: whole numbers of 0 .. 255."""
    red, green, blue = np.rint(255.0 * np.asarray(colour, np.float64).reshape(-1, 3).mean(axis=0)).tolist()
    return red, green, blue


def blank(camera: Camera) -> np.ndarray:
    """A sheet (h, w, 4) uint8 for lines: colour times coverage, and coverage."""
    return np.zeros((camera.height, camera.width, 4), np.uint8)


def joined(a: tuple[slice, slice] | None, b: tuple[slice, slice] | None) -> tuple[slice, slice] | None:
    """The rows and columns that hold two boxes."""
    if a is None or b is None:
        return a or b
    rows, columns = (slice(min(i.start, j.start), max(i.stop, j.stop)) for i, j in zip(a, b, strict=True))
    return rows, columns


def box_around(camera: Camera, points: np.ndarray) -> tuple[slice, slice] | None:
    """Rows and columns that hold the pixels of points (V, 3) and `SURROUND` more; None when none is in the picture."""
    pixels, depth = camera.project(points)
    if not (depth > 0.0).all():
        return slice(0, camera.height), slice(0, camera.width)
    if camera.lens is not None:
        pixels = corners_between(camera, points)
        if not len(pixels):
            return None
    low = np.maximum(np.floor(pixels.min(axis=0)) - SURROUND, 0.0).astype(int).tolist()
    high = np.minimum(np.ceil(pixels.max(axis=0)) + SURROUND + 1.0, (camera.width, camera.height)).astype(int).tolist()
    box = slice(low[1], high[1]), slice(low[0], high[0])
    return box if all(side.start < side.stop for side in box) else None


def corners_between(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Corners (n, 2) of the pixels that may lie between points (V, 3) in front of a camera with a lens.

    A lens bends the lines between points, but not out of the box that holds them in its straight picture.
    """
    ends, _ = replace(camera, lens=None).project(points)
    # Every few pixels first, with as much room as the straight picture changes from one of these to the next.
    step = COARSE if min(camera.width, camera.height) > 2 * COARSE else 1
    few = camera.straight[::step, ::step]
    steps = [np.abs(np.diff(few, axis=axis)).reshape(-1, 2) for axis in (0, 1)]
    room = 1.0 + np.nan_to_num(np.concatenate(steps)).max(axis=0, initial=0.0)
    rows, columns = (step * where for where in _inside(few, ends.min(axis=0) - room, ends.max(axis=0) + room))
    corners = np.zeros((0, 2))
    if len(rows):
        top, left = max(rows[0] - step, 0), max(columns[0] - step, 0)
        part = camera.straight[top : rows[-1] + step + 1, left : columns[-1] + step + 1]
        rows, columns = _inside(part, ends.min(axis=0), ends.max(axis=0))
        corners = np.array([(left + columns[end], top + rows[end]) for end in (0, -1) if len(rows)]).reshape(-1, 2)
    near, _ = camera.project(points)
    return np.concatenate([corners, near[np.isfinite(near).all(axis=1)]])


def _inside(straight: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns with places (h, w, 2) between two corners (2,)."""
    inside = np.all((straight >= low) & (straight <= high), axis=2)
    return np.flatnonzero(np.any(inside, axis=1)), np.flatnonzero(np.any(inside, axis=0))


def silhouette(camera: Camera, vertices: np.ndarray, triangles: np.ndarray, device: str = "cpu") -> np.ndarray:
    """(H, W) bool: the pixels whose centres a surface covers, seen alone. vertices (V, 3) [m], triangles (F, 3).

    `device` is the Warp device that draws it.
    """
    return seen(camera, vertices, triangles, device=device).mask


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks (H, W); 0 when both are empty, for nothing seen is no agreement."""
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 0.0


def outlines(mask: np.ndarray) -> list[np.ndarray]:
    """Closed outlines of a mask (H, W), each (n, 1, 2) int32 pixels."""
    return list(cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def dash(
    out: np.ndarray, lines: Sequence[np.ndarray], ink: Sequence[float], pattern: tuple[int, int], width: int = 2
) -> None:
    """Draw strokes of outlines, each (n, 1, 2), with gaps, both of so many pixels as `pattern` says, in place.

    A line of more than one pixel has a dark rim. Nothing is drawn along the sheet's edge, where an outline is cut off.
    """
    stroke, gap = pattern
    lines = [piece for line in lines for piece in inner(line, out.shape[1], out.shape[0])]
    strokes = [line[start : start + stroke] for line in lines for start in range(0, len(line), stroke + gap)]
    if width > 1:
        cv2.polylines(out, strokes, False, (*DARK, OPAQUE), width + 2, cv2.LINE_AA)
    cv2.polylines(out, strokes, False, (*ink, OPAQUE), width, cv2.LINE_AA)


def inner(line: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    """The pieces of an outline (n, 1, 2) that lie inside a sheet, away from its edge."""
    inside = (line >= NEAR_EDGE) & (line < (width - NEAR_EDGE, height - NEAR_EDGE))
    return runs(line, inside.all(axis=(1, 2)))


def pieces(lines: Sequence[np.ndarray], where: np.ndarray) -> list[np.ndarray]:
    """The pieces of outlines, each (n, 1, 2), whose pixels lie where a mask (H, W) bool is true."""
    return [piece for line in lines for piece in runs(line, where[line[:, 0, 1], line[:, 0, 0]])]


def runs(line: np.ndarray, kept: np.ndarray) -> list[np.ndarray]:
    """The pieces of a line (n, 1, 2) whose points are kept (n,) bool; none of an empty one."""
    if not len(line):
        return []
    cuts = np.flatnonzero(np.diff(kept)) + 1
    return [piece for piece, wanted in zip(np.split(line, cuts), np.split(kept, cuts), strict=True) if wanted[0]]


def key_of(ink: Sequence[float]) -> tuple[float, ...]:
    """A shade (3,) that looks as an ink in 0 .. 255, but is not it: an outline's pixels are the outline's alone."""
    return tuple(share + 8.0 if share < 128.0 else share - 8.0 for share in ink)

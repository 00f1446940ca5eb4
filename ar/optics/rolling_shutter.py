"""A rolling shutter: the rows of a picture are taken one after the other, and a camera that moves is elsewhere in each.

A picture's time is that of its middle row. Times here are counted from it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from .camera import Camera

# What is seen moves by so many pixels at most while a band of rows is taken: then no row is off by half as much.
STEP = 0.4
# Moments of a picture in which motion is looked at; a band's fewest rows; steps to the row in which a point is seen.
MOMENTS, FEWEST, STEPS = 33, 4, 6


def row_time(row: np.ndarray | float, height: int, readout: float) -> np.ndarray | float:
    """When a row of a picture of so many is taken [s]; rows beyond the picture as its first or last one."""
    return readout * (np.clip(np.asarray(row) / max(height - 1, 1), 0.0, 1.0) - 0.5)


def row_bands(camera_at: Callable[[float], Camera], readout: float, points: np.ndarray) -> list[tuple[slice, Camera]]:
    """Bands of rows from top to bottom, each with the camera at its time, of these rows alone.

    There are so many that points (n, 3) [m] move by at most `STEP` pixels in each.
    """
    middle = camera_at(0.0)
    moments = readout * np.linspace(-0.5, 0.5, MOMENTS)
    pixels = np.stack([camera_at(float(moment)).project(points)[0] for moment in moments])
    fastest = float(np.nan_to_num(np.linalg.norm(np.diff(pixels, axis=0), axis=2)).max()) * (MOMENTS - 1)
    count = int(np.clip(np.ceil(fastest / STEP), 1, max(middle.height // FEWEST, 1)))
    edges = np.linspace(0, middle.height, count + 1).round().astype(int).tolist()
    bands = []
    for top, low in pairwise(edges):
        camera = camera_at(float(row_time(0.5 * (top + low - 1), middle.height, readout)))
        bands.append((slice(top, low), camera.cropped(slice(top, low), slice(0, middle.width))))
    return bands


def time_of_point(camera_at: Callable[[float], Camera], readout: float, point: np.ndarray) -> float:
    """When the row is taken in which a point (3,) [m] is seen [s]; 0 where it has no pixel."""
    time = 0.0
    for _ in range(STEPS):
        camera = camera_at(time)
        (pixel,), _ = camera.project(point[None])
        if not np.isfinite(pixel).all():
            return 0.0
        time = float(row_time(float(pixel[1]), camera.height, readout))
    return time

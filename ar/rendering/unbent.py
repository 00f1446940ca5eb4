"""Where each pixel would be without its camera's lens, on a device: what lets triangles keep their straight edges."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import warp as wp

from ..optics.camera import Camera
from .parallel import forward_kernel, load, run_length

# About so many pixels share a cell of the table that finds them again.
CELL = 64


@wp.struct
class Unbent:
    """Pixels of B pictures without their lenses, and which pixels are in a cell of the straight picture.

    `pixels` (B, H, W) [pixel], NaN where the lens sees nothing; empty where no camera has a lens. `cells` (B, n, m, 4):
    the least box of the pixels in a cell, as first column and row, and last column and row. It is empty where a cell
    has no pixel. `corner` and `scale` (B,) take a straight pixel to its cell: (column, row) = (pixel - corner) scale.
    """

    pixels: wp.array3d(dtype=wp.vec2d)
    cells: wp.array4d(dtype=wp.int32)
    corner: wp.array(dtype=wp.vec2d)
    scale: wp.array(dtype=wp.vec2d)


def unbent(cameras: Sequence[Camera], device: str) -> Unbent:
    """Of cameras that all have one size; those without a lens beside others have one that does nothing."""
    if all(camera.lens is None for camera in cameras):
        return without_lens(device)
    return with_lens(tuple(cameras), device)


@lru_cache(maxsize=4)
def without_lens(device: str) -> Unbent:
    """What kernels are given where no camera has a lens."""
    out = Unbent()
    out.pixels = wp.empty((0, 0, 0), dtype=wp.vec2d, device=device)
    return out


@lru_cache(maxsize=4)
def with_lens(cameras: tuple[Camera, ...], device: str) -> Unbent:
    """As `unbent`: a camera that stands still is asked for in every picture, and a part of it by each surface."""
    straight = np.stack([camera.straight for camera in cameras])
    count, height, width = straight.shape[:3]
    side = max(int(np.sqrt(height * width / CELL)), 1)
    with np.errstate(invalid="ignore"):
        low = np.fmin.reduce(straight.reshape(count, -1, 2), axis=1)
        high = np.fmax.reduce(straight.reshape(count, -1, 2), axis=1)
    scale = (side - 1e-6) / np.maximum(high - low, 1e-9)
    cells = np.tile(np.array([2**30, 2**30, -1, -1], np.int32), (count, side, side, 1))
    out = Unbent()
    out.pixels = wp.array(straight, dtype=wp.vec2d, device=device)
    out.cells = wp.array(cells, dtype=wp.int32, device=device)
    out.corner = wp.array(np.nan_to_num(low), dtype=wp.vec2d, device=device)
    out.scale = wp.array(np.nan_to_num(scale), dtype=wp.vec2d, device=device)
    load(device, fill_cells.module)
    run = run_length(device)
    wp.launch(fill_cells, -(-out.pixels.size // run), [out, run, out.pixels.size], [out.cells], device=device)
    return out


@forward_kernel
def fill_cells(
    through: Unbent,
    run: wp.int32,
    end: wp.int32,
    # output
    cells: wp.array4d(dtype=wp.int32),
):
    """A run of pixels, each into the box of its cell."""
    start = wp.tid() * run
    height = through.pixels.shape[1]
    width = through.pixels.shape[2]
    for index in range(start, wp.min(start + run, end)):
        picture = index / (height * width)
        row = (index / width) % height
        column = index % width
        at = through.pixels[picture, row, column]
        if wp.isfinite(at[0]):
            scale = through.scale[picture]
            m = wp.int32((at[0] - through.corner[picture][0]) * scale[0])
            n = wp.int32((at[1] - through.corner[picture][1]) * scale[1])
            wp.atomic_min(cells, picture, n, m, 0, column)
            wp.atomic_min(cells, picture, n, m, 1, row)
            wp.atomic_max(cells, picture, n, m, 2, column)
            wp.atomic_max(cells, picture, n, m, 3, row)


@wp.func
def pixel_at(picture: wp.int32, column: wp.int32, row: wp.int32, pixels: wp.array3d(dtype=wp.vec2d)) -> wp.vec3d:
    """A pixel as (u, v, 1), where it would be without its lens."""
    if pixels.shape[0] == 0:
        return wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
    at = pixels[picture, row, column]
    return wp.vec3d(at[0], at[1], wp.float64(1.0))

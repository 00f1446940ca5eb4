"""Undistorted pixel positions, at which the rasteriser tests the pixels of a camera with a lens."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import warp as wp

from ..optics.camera import Camera
from .parallel import forward_kernel, get_chunk_size, load_modules

CELL_PIXELS = 64  # Average number of pixels in a cell of the lookup table.


@wp.struct
class Undistortion:
    """Undistorted pixels of B images, and a lookup table of the pixels in each cell of the undistorted image.

    `pixels` (B, H, W) [pixel] is NaN where no point is projected, and empty if no camera has a lens. `cells` (B, n, m,
    4) has the box of the pixels in each cell: first column and row, last column and row (last < first without a pixel).
    `origin` and `scale` (B,) map an undistorted pixel to its cell: (column, row) = (pixel - origin) scale.
    """

    pixels: wp.array3d(dtype=wp.vec2d)
    cells: wp.array4d(dtype=wp.int32)
    origin: wp.array(dtype=wp.vec2d)
    scale: wp.array(dtype=wp.vec2d)


def build_undistortion(cameras: Sequence[Camera], device: str) -> Undistortion:
    """Compute the undistorted pixels of cameras of equal size; empty if no camera has a lens."""
    if all(camera.lens is None for camera in cameras):
        return build_empty_undistortion(device)
    return get_undistortion(tuple(cameras), device)


@lru_cache(maxsize=4)
def build_empty_undistortion(device: str) -> Undistortion:
    """Build the empty `Undistortion` that kernels get for cameras without a lens."""
    out = Undistortion()
    out.pixels = wp.empty((0, 0, 0), dtype=wp.vec2d, device=device)
    return out


@lru_cache(maxsize=4)
def get_undistortion(cameras: tuple[Camera, ...], device: str) -> Undistortion:
    """Compute `build_undistortion`, cached for fixed cameras and for image parts that several surfaces use."""
    straight = np.stack([camera.straight for camera in cameras])
    count, height, width = straight.shape[:3]
    side = max(int(np.sqrt(height * width / CELL_PIXELS)), 1)
    with np.errstate(invalid="ignore"):
        low = np.fmin.reduce(straight.reshape(count, -1, 2), axis=1)
        high = np.fmax.reduce(straight.reshape(count, -1, 2), axis=1)
    scale = (side - 1e-6) / np.maximum(high - low, 1e-9)
    cells = np.tile(np.array([2**30, 2**30, -1, -1], np.int32), (count, side, side, 1))
    out = Undistortion()
    out.pixels = wp.array(straight, dtype=wp.vec2d, device=device)
    out.cells = wp.array(cells, dtype=wp.int32, device=device)
    out.origin = wp.array(np.nan_to_num(low), dtype=wp.vec2d, device=device)
    out.scale = wp.array(np.nan_to_num(scale), dtype=wp.vec2d, device=device)
    load_modules(device, fill_cells.module)
    run = get_chunk_size(device)
    wp.launch(fill_cells, -(-out.pixels.size // run), [out, run, out.pixels.size], [out.cells], device=device)
    return out


@forward_kernel
def fill_cells(
    undistortion: Undistortion,
    chunk_size: wp.int32,
    end: wp.int32,
    # output
    cells: wp.array4d(dtype=wp.int32),
):
    """Extend the box of the cell of each pixel in a chunk of pixels."""
    start = wp.tid() * chunk_size
    height = undistortion.pixels.shape[1]
    width = undistortion.pixels.shape[2]
    for index in range(start, wp.min(start + chunk_size, end)):
        picture = index / (height * width)
        row = (index / width) % height
        column = index % width
        at = undistortion.pixels[picture, row, column]
        if wp.isfinite(at[0]):
            scale = undistortion.scale[picture]
            m = wp.int32((at[0] - undistortion.origin[picture][0]) * scale[0])
            n = wp.int32((at[1] - undistortion.origin[picture][1]) * scale[1])
            wp.atomic_min(cells, picture, n, m, 0, column)
            wp.atomic_min(cells, picture, n, m, 1, row)
            wp.atomic_max(cells, picture, n, m, 2, column)
            wp.atomic_max(cells, picture, n, m, 3, row)


@wp.func
def undistort_pixel(image: wp.int32, column: wp.int32, row: wp.int32, pixels: wp.array3d(dtype=wp.vec2d)) -> wp.vec3d:
    """Return the undistorted position (u, v, 1) of a pixel."""
    if pixels.shape[0] == 0:
        return wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
    at = pixels[image, row, column]
    return wp.vec3d(at[0], at[1], wp.float64(1.0))


@wp.func
def distort_pixel_box(image: wp.int32, low: wp.vec2d, high: wp.vec2d, undistortion: Undistortion) -> wp.vec4i:
    """Return the pixel box (first column, first row, last column, last row) of a box in the undistorted image."""
    out = wp.vec4i(2147483647, 2147483647, -1, -1)
    corner = undistortion.origin[image]
    scale = undistortion.scale[image]
    zero = wp.float64(0.0)
    rows = undistortion.cells.shape[1]
    columns = undistortion.cells.shape[2]
    # One cell more on each side, so that rounding loses no pixel.
    top = wp.int32(wp.clamp((low[1] - corner[1]) * scale[1] - wp.float64(1.0), zero, wp.float64(rows)))
    left = wp.int32(wp.clamp((low[0] - corner[0]) * scale[0] - wp.float64(1.0), zero, wp.float64(columns)))
    below = wp.int32(wp.clamp((high[1] - corner[1]) * scale[1] + wp.float64(2.0), zero, wp.float64(rows)))
    right = wp.int32(wp.clamp((high[0] - corner[0]) * scale[0] + wp.float64(2.0), zero, wp.float64(columns)))
    for i in range(top, below):
        for j in range(left, right):
            out = wp.vec4i(
                wp.min(out[0], undistortion.cells[image, i, j, 0]),
                wp.min(out[1], undistortion.cells[image, i, j, 1]),
                wp.max(out[2], undistortion.cells[image, i, j, 2]),
                wp.max(out[3], undistortion.cells[image, i, j, 3]),
            )
    return out

"""The rasteriser's kernel for cameras with a lens: each pixel is tested where it would be without it."""

from __future__ import annotations

import warp as wp

from .parallel import forward_kernel
from .triangle import box_of, edge, first_row
from .unbent import Unbent


@wp.func
def box_through_lens(picture: wp.int32, low: wp.vec2d, high: wp.vec2d, through: Unbent) -> wp.vec4i:
    """The pixels (first column, first row, last column, last row) that may lie in a box of the straight picture."""
    out = wp.vec4i(2147483647, 2147483647, -1, -1)
    corner = through.corner[picture]
    scale = through.scale[picture]
    zero = wp.float64(0.0)
    rows = through.cells.shape[1]
    columns = through.cells.shape[2]
    # One cell more on each side: rounding must not lose a pixel.
    top = wp.int32(wp.clamp((low[1] - corner[1]) * scale[1] - wp.float64(1.0), zero, wp.float64(rows)))
    left = wp.int32(wp.clamp((low[0] - corner[0]) * scale[0] - wp.float64(1.0), zero, wp.float64(columns)))
    below = wp.int32(wp.clamp((high[1] - corner[1]) * scale[1] + wp.float64(2.0), zero, wp.float64(rows)))
    right = wp.int32(wp.clamp((high[0] - corner[0]) * scale[0] + wp.float64(2.0), zero, wp.float64(columns)))
    for i in range(top, below):
        for j in range(left, right):
            out = wp.vec4i(
                wp.min(out[0], through.cells[picture, i, j, 0]),
                wp.min(out[1], through.cells[picture, i, j, 1]),
                wp.max(out[2], through.cells[picture, i, j, 2]),
                wp.max(out[3], through.cells[picture, i, j, 3]),
            )
    return out


@wp.func
def draw_through_lens(
    picture: wp.int32,
    face: wp.int32,
    q: wp.array2d(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    near: wp.float64,
    begin: wp.int32,
    end: wp.int32,
    part: wp.int32,
    parts: wp.int32,
    through: Unbent,
    nearest: wp.array3d(dtype=wp.uint64),
):
    """Keep, at each pixel whose ray meets triangle `face`, the minimum of (depth, face); rows as in the rasteriser."""
    t = triangles[face]
    a = q[picture, t[0]]
    b = q[picture, t[1]]
    c = q[picture, t[2]]
    normal = wp.cross(b - a, c - a)
    volume = wp.dot(normal, a)
    if volume == wp.float64(0.0):
        return
    box = box_of(a, b, c, near)
    held = box_through_lens(picture, wp.vec2d(box[0], box[1]), wp.vec2d(box[2], box[3]), through)
    first = wp.max(held[1], begin)
    stop = wp.min(held[3] + 1, end)
    if held[0] > held[2] or first >= stop:
        return
    zero = wp.float64(0.0)
    side = wp.sign(volume)
    ea = edge(b, c, t[1], t[2]) * side
    eb = edge(c, a, t[2], t[0]) * side
    ec = edge(a, b, t[0], t[1]) * side
    for row in range(first_row(first, begin, part, parts), stop, parts):
        for column in range(held[0], held[2] + 1):
            at = through.pixels[picture, row, column]
            p = wp.vec3d(at[0], at[1], wp.float64(1.0))
            if wp.dot(ea, p) >= zero and wp.dot(eb, p) >= zero and wp.dot(ec, p) >= zero:
                across = wp.dot(normal, p)
                if across * side > zero:
                    z = volume / across
                    if z >= near:
                        bits = wp.uint64(wp.cast(wp.float32(z), wp.uint32))
                        wp.atomic_min(nearest, picture, row, column, (bits << wp.uint64(32)) | wp.uint64(face))


@forward_kernel
def keep_nearest_through_lens(
    q: wp.array2d(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    since: wp.int32,
    near: wp.float64,
    begin: wp.int32,
    end: wp.int32,
    parts: wp.int32,
    run: wp.int32,
    through: Unbent,
    # outputs
    nearest: wp.array3d(dtype=wp.uint64),
):
    """A run of triangles in one picture, each in a part of the rows begin .. end - 1."""
    picture, chunk, part = wp.tid()
    start = since + chunk * run
    for face in range(start, wp.min(start + run, triangles.shape[0])):
        draw_through_lens(picture, face, q, triangles, near, begin, end, part, parts, through, nearest)

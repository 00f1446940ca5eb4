"""Z-buffer rasteriser in Warp, which finds the visible triangle at each pixel.

Triangles are tested in homogeneous pixel coordinates q = K x_camera = (u w, v w, w), so that no clipping is needed
(Olano & Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates"). With p = (u, v, 1):

    e_a = p . (q_b x q_c); e_b, e_c by cycling      edge functions, of one sign inside
    n = (q_b - q_a) x (q_c - q_a)                   p . n is the sum of the edge functions
    n . q_a / p . n                                 depth
    e / sum e                                       weights on the triangle itself, hence perspective-correct

With a lens the formulas are the same, but p is the undistorted position of the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import warp as wp

from ..optics.camera import Camera
from .lens_rasteriser import (
    Undistortion,
    build_empty_undistortion,
    build_undistortion,
    distort_pixel_box,
    undistort_pixel,
)
from .parallel import forward_kernel, get_chunk_size, get_workers, launch_in_bands, load_modules, run_in_bands
from .triangle import compute_edge, compute_triangle_box, compute_weights_from_corners, find_first_row

EMPTY_PIXEL = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Value of an empty z-buffer entry."""
NEAR_PLANE = 1e-3
"""Depth of the near plane [m]; nothing nearer to a camera is drawn."""
ROW_THREADS = 8  # Number of threads that share the rows of a triangle on a GPU.
MIN_PIXELS = 8  # Number of pixels per triangle above which CPU threads divide the rows, not the triangles.


@dataclass(frozen=True, eq=False)
class Fragments:
    """Visible triangle at each pixel of an image.

    `face` (H, W) int32 is the triangle's index, -1 where empty. `weights` (H, W, 3) float32 are barycentric weights of
    its corners, 0 where empty. `depth` (H, W) float32 [m] is z in the camera frame, 0 where empty.
    """

    face: np.ndarray
    weights: np.ndarray
    depth: np.ndarray

    @cached_property
    def mask(self) -> np.ndarray:
        """Mask (H, W) of the pixels with a triangle."""
        return self.face >= 0

    def interpolate(self, triangles: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Interpolate vertex values (V, C) at every pixel (H, W, C), 0 where empty, for the same `triangles` (F, 3)."""
        picture = np.zeros((*self.face.shape, values.shape[1]), values.dtype)
        seen = self.mask
        picture[seen] = np.einsum("nk,nkc->nc", self.weights[seen], values[triangles[self.face[seen]]])
        return picture


def rasterise(
    camera: Camera, vertices: np.ndarray, triangles: np.ndarray, near: float = NEAR_PLANE, device: str = "cpu"
) -> Fragments:
    """Find the nearest triangle at every pixel centre.

    Both sides of a triangle are visible. A pixel centre on an edge belongs to both neighbours, so that shared edges
    have no gaps; at equal depth the lower index is kept. Triangles without area are not drawn.

    Parameters
    ----------
    vertices, triangles
        World points (V, 3) [m]; vertex indices (F, 3).
    near
        Smallest depth [m] that is drawn; triangles may extend through this plane and behind the camera.
    device
        Warp device that computes the fragments.

    Raises
    ------
    ValueError
        Shapes are wrong, indices are out of range, vertices are not finite, or `near` is <= 0.
    """
    found = rasterise_surface(camera, vertices, triangles, near, device)
    shape, rows = (camera.height, camera.width), found.rows
    face = wp.full(shape, value=-1, dtype=wp.int32, device=device)
    weights = wp.zeros(shape, dtype=wp.vec3f, device=device)
    depth = wp.zeros(shape, dtype=wp.float32, device=device)
    inputs = [found.z_buffer[0, rows], found.points, found.triangles, rows.start, found.undistortion.pixels]
    launch_in_bands(
        read_nearest, inputs, [face[rows], weights[rows], depth[rows]], (rows.stop - rows.start) * camera.width, device
    )
    return Fragments(face.numpy(), weights.numpy(), depth.numpy())


@dataclass(frozen=True, eq=False)
class RasterisedSurface:
    """Surface rasterised in one image, on a device.

    `points` (1, V) vec3d are homogeneous pixel coordinates, undistorted; `triangles` (F,) vec3i; `z_buffer` (1, H, W)
    has (depth, face); only `rows` may be covered. `undistortion` is the result of `build_undistortion`.
    """

    points: wp.array
    triangles: wp.array
    z_buffer: wp.array
    rows: slice
    undistortion: Undistortion

    @cached_property
    def mask(self) -> np.ndarray:
        """Mask (H, W) of the pixels whose centres the surface covers."""
        mask = wp.empty(self.z_buffer.size, dtype=wp.uint8, device=self.z_buffer.device)
        launch_in_bands(mark_covered, [self.z_buffer.flatten()], [mask], mask.size, str(mask.device))
        return mask.numpy().reshape(self.z_buffer.shape[1:]).view(bool)


def rasterise_surface(
    camera: Camera, vertices: np.ndarray, triangles: np.ndarray, near: float = NEAR_PLANE, device: str = "cpu"
) -> RasterisedSurface:
    """Rasterise a surface into a z-buffer; arguments and errors are as in `rasterise`."""
    vertices, triangles = check_mesh(vertices, triangles)
    if not near > 0.0:
        raise ValueError(f"near is {near} m: the near plane must lie in front of the camera.")
    homogeneous = camera.to_camera_frame(vertices) @ camera.K.T
    rows = (
        slice(*find_covered_rows(homogeneous, near, camera.height)) if camera.lens is None else slice(0, camera.height)
    )
    points = wp.array(homogeneous[None], dtype=wp.vec3d, device=device)
    corners = wp.array(triangles, dtype=wp.vec3i, device=device, copy=False)
    nearest = allocate_z_buffer(1, camera.height, camera.width, device)
    through = build_undistortion([camera], device)
    draw_triangles(points, corners, 0, rows, nearest, device, near, through)
    return RasterisedSurface(points, corners, nearest, rows, through)


def allocate_z_buffer(count: int, height: int, width: int, device: str) -> wp.array:
    """Allocate empty z-buffers (count, height, width) of (depth, face) on a device."""
    return wp.full((count, height, width), value=EMPTY_PIXEL, dtype=wp.uint64, device=device)


def draw_triangles(
    points: wp.array, triangles: wp.array, start: int, rows: slice, z_buffer: wp.array, device: str,
    near: float = NEAR_PLANE, undistortion: Undistortion | None = None,
) -> None:  # fmt: skip
    """Draw the triangles from index `start` on into the given rows of z-buffers (B, H, W).

    `points` (B, V) vec3d are homogeneous pixel coordinates in each image. `triangles` (F,) vec3i are the same in all
    images. `undistortion` is needed if a camera has a lens.
    """
    undistortion = build_empty_undistortion(device) if undistortion is None else undistortion
    load_modules(device, keep_nearest.module)
    count, run = triangles.shape[0] - start, get_chunk_size(device)
    # On a GPU the rows of a triangle are shared by several threads.
    parts = 1 if device == "cpu" else ROW_THREADS

    def draw_rows(begin: int, end: int, first: int = 0, last: int = count, buffer: wp.array = z_buffer) -> None:
        size = z_buffer.shape[0], -(-(last - first) // run), parts
        span = rows.start + begin, rows.start + end
        inputs = [points, triangles[: start + last], start + first, wp.float64(near), *span, parts, run, undistortion]
        wp.launch(keep_nearest, size, inputs, [buffer], device=device)

    pool, cores = get_workers()
    if not count:
        return None
    if device != "cpu" or cores == 1 or count * MIN_PIXELS < z_buffer.size:
        return run_in_bands(draw_rows, rows.stop - rows.start, device)
    # Many small triangles: every band of rows would prepare all of them, so each thread draws some into its own buffer.
    edges = np.linspace(0, count, cores + 1).astype(int).tolist()
    buffers = [z_buffer, *(wp.full_like(z_buffer, EMPTY_PIXEL) for _ in edges[2:])]
    list(pool.map(partial(draw_rows, 0, rows.stop - rows.start), edges[:-1], edges[1:], buffers))
    for other in buffers[1:]:
        np.minimum(z_buffer.numpy(), other.numpy(), out=z_buffer.numpy())


def find_covered_rows(points: np.ndarray, near: float, height: int) -> tuple[int, int]:
    """Return the image rows that points (V, 3) (u w, v w, w) may cover: all rows if a point is nearer than `near`."""
    if not len(points):
        return 0, 0
    if points[:, 2].min() < near:
        return 0, height
    rows = points[:, 1] / points[:, 2]
    first, last = np.clip([np.floor(rows.min()), np.ceil(rows.max()) + 1.0], 0, height).astype(int).tolist()
    return first, last


def check_mesh(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) as float64 and triangles (F, 3) as int32; ValueError if the mesh is invalid."""
    vertices = np.asarray(vertices, np.float64)
    triangles = np.asarray(triangles, np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"a surface is vertices (V, 3) and triangles (F, 3), not {vertices.shape}, {triangles.shape}.")
    if not np.isfinite(vertices).all():
        raise ValueError("a vertex is not finite: every coordinate must be a finite number of metres.")
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise ValueError(f"a triangle names a vertex outside 0 .. {len(vertices) - 1}.")
    return vertices, triangles


@wp.func
def unpack_depth(key: wp.uint64) -> wp.float32:
    """Return the depth [m] in an entry of the z-buffer."""
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)


@wp.func
def unpack_face(key: wp.uint64) -> wp.int32:
    """Return the face index in an entry of the z-buffer."""
    return wp.int32(key & wp.uint64(0xFFFFFFFF))


@wp.func
def clip_row_span(slope: wp.float64, offset: wp.float64, span: wp.vec2d) -> wp.vec2d:
    """Restrict a row's span to slope u + offset >= 0, with a margin, as each pixel is tested again."""
    slack = wp.float64(1.0e-3)
    if slope > wp.float64(0.0):
        return wp.vec2d(wp.max(span[0], -offset / slope - slack), span[1])
    if slope < wp.float64(0.0):
        return wp.vec2d(span[0], wp.min(span[1], -offset / slope + slack))
    return span


@wp.func
def draw_triangle(
    image: wp.int32, face: wp.int32, q: wp.array2d(dtype=wp.vec3d), triangles: wp.array(dtype=wp.vec3i),
    near: wp.float64, begin: wp.int32, end: wp.int32, part: wp.int32, part_count: wp.int32, undistortion: Undistortion,
    z_buffer: wp.array3d(dtype=wp.uint64),
):  # fmt: skip
    """Update the z-buffer at each pixel centre in triangle `face` with the minimum of (depth, face).

    Only rows begin + part, begin + part + part_count, ... below `end` are drawn. Depth and face share 64 bits, because
    bits of positive floats sort like the floats. With a lens, a pixel is tested at its undistorted position.
    """
    t = triangles[face]
    a = q[image, t[0]]
    b = q[image, t[1]]
    c = q[image, t[2]]
    normal = wp.cross(b - a, c - a)
    volume = wp.dot(normal, a)
    if volume == wp.float64(0.0):
        return
    box = compute_triangle_box(a, b, c, near)
    # Tolerance, so that rounding excludes no pixel on the box.
    slack = wp.vec2d(wp.float64(1.0e-6))
    low = wp.vec2d(box[0], box[1]) - slack
    high = wp.vec2d(box[2], box[3]) + slack
    zero = wp.float64(0.0)
    left = wp.clamp(wp.ceil(low[0]), zero, wp.float64(z_buffer.shape[2]))
    right = wp.clamp(wp.floor(high[0]), wp.float64(-1.0), wp.float64(z_buffer.shape[2] - 1))
    first = wp.int32(wp.clamp(wp.ceil(low[1]), wp.float64(begin), wp.float64(end)))
    stop = wp.int32(wp.clamp(wp.floor(high[1]) + wp.float64(1.0), wp.float64(begin), wp.float64(end)))
    bent = undistortion.pixels.shape[0] > 0
    if bent:
        held = distort_pixel_box(image, low, high, undistortion)
        left = wp.float64(held[0])
        right = wp.float64(held[2])
        first = wp.max(held[1], begin)
        stop = wp.min(held[3] + 1, end)
    if left > right or first >= stop:
        return
    side = wp.sign(volume)
    ea = compute_edge(b, c, t[1], t[2]) * side
    eb = compute_edge(c, a, t[2], t[0]) * side
    ec = compute_edge(a, b, t[0], t[1]) * side
    for row in range(find_first_row(first, begin, part, part_count), stop, part_count):
        v = wp.float64(row)
        ra = ea[1] * v + ea[2]
        rb = eb[1] * v + eb[2]
        rc = ec[1] * v + ec[2]
        span = wp.vec2d(left, right)
        if not bent:
            span = clip_row_span(ec[0], rc, clip_row_span(eb[0], rb, clip_row_span(ea[0], ra, span)))
        first_u = wp.int32(wp.min(wp.ceil(span[0]), right + wp.float64(1.0)))
        last_u = wp.int32(wp.max(wp.floor(span[1]), left - wp.float64(1.0)))
        for column in range(first_u, last_u + 1):
            u = wp.float64(column)
            if bent:
                at = undistortion.pixels[image, row, column]
                u = at[0]
                v = at[1]
                ra = ea[1] * v + ea[2]
                rb = eb[1] * v + eb[2]
                rc = ec[1] * v + ec[2]
            if ea[0] * u + ra >= zero and eb[0] * u + rb >= zero and ec[0] * u + rc >= zero:
                across = normal[0] * u + normal[1] * v + normal[2]
                if across * side > zero:
                    z = volume / across
                    if z >= near:
                        bits = wp.uint64(wp.cast(wp.float32(z), wp.uint32))
                        wp.atomic_min(z_buffer, image, row, column, (bits << wp.uint64(32)) | wp.uint64(face))


@forward_kernel
def keep_nearest(
    q: wp.array2d(dtype=wp.vec3d), triangles: wp.array(dtype=wp.vec3i), first: wp.int32, near: wp.float64,
    begin: wp.int32, end: wp.int32, part_count: wp.int32, chunk_size: wp.int32, undistortion: Undistortion,
    # outputs
    z_buffer: wp.array3d(dtype=wp.uint64),
):  # fmt: skip
    """Draw a chunk of triangles into the z-buffer of one image, in one part of the rows begin .. end - 1."""
    picture, chunk, part = wp.tid()
    start = first + chunk * chunk_size
    for face in range(start, wp.min(start + chunk_size, triangles.shape[0])):
        draw_triangle(picture, face, q, triangles, near, begin, end, part, part_count, undistortion, z_buffer)


@forward_kernel
def mark_covered(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, z_buffer: wp.array(dtype=wp.uint64),
    # output
    mask: wp.array(dtype=wp.uint8),
):  # fmt: skip
    """Set the mask of each pixel to 1 if a surface is visible, else 0."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        mask[index] = wp.uint8(wp.where(z_buffer[index] != EMPTY_PIXEL, 1, 0))


@forward_kernel
def read_nearest(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, z_buffer: wp.array2d(dtype=wp.uint64),
    q: wp.array2d(dtype=wp.vec3d), triangles: wp.array(dtype=wp.vec3i), first_row: wp.int32,
    pixels: wp.array3d(dtype=wp.vec2d),
    # outputs
    face: wp.array2d(dtype=wp.int32), weights: wp.array2d(dtype=wp.vec3f), depth: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Read face, barycentric weights and depth at each pixel from the z-buffer; row 0 is `first_row` of the image."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / z_buffer.shape[1]
        column = index - row * z_buffer.shape[1]
        key = z_buffer[row, column]
        if key != EMPTY_PIXEL:
            winner = unpack_face(key)
            t = triangles[winner]
            face[row, column] = winner
            p = undistort_pixel(0, column, first_row + row, pixels)
            weights[row, column] = compute_weights_from_corners(p, q[0, t[0]], q[0, t[1]], q[0, t[2]])
            depth[row, column] = unpack_depth(key)

"""A hidden surface that shines through the ground, which is dimmed round it."""

from __future__ import annotations

import cv2
import numpy as np
import warp as wp

from .camera import Camera
from .layer import Layer, vertex_normals
from .parallel import forward_kernel, launch_in_bands
from .rasteriser import NOTHING, Seen, depth_of, face_of, weights_of

# Light that falls to 1 / e over this depth under the surface [m]: the deeper, the darker.
FADE = wp.constant(0.03)
# Width of the window's soft rim round the silhouette [pixel].
SURROUND = wp.constant(24)


def draw_window(
    colour: np.ndarray, depth: np.ndarray, box: tuple[slice, slice], camera: Camera, hidden: Layer, seen: Seen
) -> None:
    """Dim the ground round the silhouette with a soft rim, and let the hidden surface shine through, in place.

    Parameters
    ----------
    colour, depth
        The picture (H, W, 3) uint8 and its depth (H, W) float32 [m].
    box, camera
        Rows and columns of the picture in which to draw, and the camera of that part.
    hidden, seen
        The surface, and what that camera sees of it, on the processor.
    """
    outside = cv2.distanceTransform((~seen.mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    towards = vertex_normals(hidden.vertices, hidden.triangles) @ camera.T_camera_world[2, :3]
    inputs = [
        box[0].start, box[1].start, camera.width, seen.nearest.flatten(), seen.points, seen.triangles,
        wp.array(outside.reshape(-1), dtype=wp.float32, device="cpu", copy=False),
        wp.array(towards, dtype=wp.float32, device="cpu"),
        wp.array(255.0 * np.asarray(hidden.colour), dtype=wp.vec3f, device="cpu"),
        wp.array(depth, dtype=wp.float32, device="cpu", copy=False),
    ]  # fmt: skip
    wp.load_module(__name__, device="cpu")
    ground = wp.array(colour, dtype=wp.vec3ub, device="cpu", copy=False)
    launch_in_bands(shine_through, inputs, [ground], camera.height * camera.width, "cpu")


@forward_kernel
def shine_through(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    top: wp.int32,
    left: wp.int32,
    width: wp.int32,
    nearest: wp.array(dtype=wp.uint64),
    q: wp.array2d(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    outside: wp.array(dtype=wp.float32),
    towards: wp.array(dtype=wp.float32),
    colours: wp.array(dtype=wp.vec3f),
    depth: wp.array2d(dtype=wp.float32),
    # output
    ground: wp.array2d(dtype=wp.vec3ub),
):
    """A run of the box's pixels begin .. end - 1; `outside` is how far each is from the silhouette [pixel]."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        window = wp.clamp(1.25 - 1.25 * outside[index] / wp.float32(SURROUND), 0.0, 1.0)
        if window > 0.0:
            row = index / width
            column = index - row * width
            was = ground[top + row, left + column]
            share = 1.0 - 0.62 * window * window * (3.0 - 2.0 * window)
            light = share * wp.vec3f(wp.float32(was[0]), wp.float32(was[1]), wp.float32(was[2]))
            key = nearest[index]
            if key != NOTHING:
                t = triangles[face_of(key)]
                w = weights_of(column, row, q[0, t[0]], q[0, t[1]], q[0, t[2]])
                facing = w[0] * towards[t[0]] + w[1] * towards[t[1]] + w[2] * towards[t[2]]
                tint = w[0] * colours[t[0]] + w[1] * colours[t[1]] + w[2] * colours[t[2]]
                surface = depth[top + row, left + column]
                under = wp.float32(0.0)
                if surface > 0.0:
                    under = wp.max(depth_of(key) - surface, 0.0)
                light += 1.1 * (0.25 + 0.75 * wp.abs(facing)) * wp.exp(-under / FADE) * tint
            ground[top + row, left + column] = wp.vec3ub(
                wp.uint8(wp.min(light[0], 255.0)), wp.uint8(wp.min(light[1], 255.0)), wp.uint8(wp.min(light[2], 255.0))
            )

"""A hidden surface that shines through the ground, which is dimmed round it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import warp as wp

from .camera import Camera
from .layer import Layer, vertex_normals
from .parallel import forward_kernel, launch_in_bands, load
from .rasteriser import NOTHING, Seen, depth_of, face_of, weights_of
from .renderer import Pictures

# Light that falls to 1 / e over this depth under the surface [m]: the deeper, the darker.
FADE = wp.constant(0.03)
# Width of the window's soft rim round the silhouette [pixel].
SURROUND = wp.constant(24)
# Lengths of OpenCV's steps along rows and columns, and across both [pixel]; steps that hold the rim.
STRAIGHT, SLANTED = wp.constant(0.955), wp.constant(1.3693)
REACH = wp.constant(26)


def with_window(
    drawn: Pictures,
    box: tuple[slice, slice],
    camera: Camera,
    hidden: Layer,
    seen: Seen,
    mask: np.ndarray,
    occluders: Sequence[int],
) -> np.ndarray:
    """The picture (H, W, 3) uint8 with the ground dimmed round the silhouette, where the hidden surface shines through.

    Parameters
    ----------
    drawn
        The one picture, on its device.
    box, camera
        Rows and columns of the picture in which to draw, and the camera of that part.
    hidden, seen, mask
        The surface, what that camera sees of it, on the same device, and where (h, w).
    occluders
        Ids of the layers that stay as they are.
    """
    device = str(drawn.colour.device)
    towards = vertex_normals(hidden.vertices, hidden.triangles) @ camera.T_camera_world[2, :3]
    over = np.isin(np.arange(256), occluders)
    inputs = [
        box[0].start, box[1].start, camera.width, seen.nearest.flatten(), seen.points, seen.triangles,
        outside(mask, device),
        wp.array(towards, dtype=wp.float32, device=device),
        wp.array(255.0 * np.asarray(hidden.colour), dtype=wp.vec3f, device=device),
        drawn.depth[0], drawn.segmentation[0], wp.array(over, dtype=wp.bool, device=device),
    ]  # fmt: skip
    load(device, __name__)
    ground = wp.clone(drawn.colour[0])
    launch_in_bands(shine_through, inputs, [ground], camera.height * camera.width, device)
    return ground.numpy()


def outside(mask: np.ndarray, device: str) -> wp.array:
    """How far each pixel, flat, is from a mask (h, w) [pixel], as far as the rim reaches; a chamfer distance.

    OpenCV's on the processor, and the same by kernels on a card.
    """
    if device == "cpu":
        distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
        return wp.array(distance.reshape(-1), dtype=wp.float32, device=device, copy=False)
    return chamfer(wp.array(mask.view(np.uint8), dtype=wp.uint8, device=device), device)


def chamfer(mask: wp.array, device: str) -> wp.array:
    """How far each pixel, flat, is from a mask (h, w) uint8 [pixel], as far as the rim reaches."""
    load(device, __name__)
    aside = wp.empty(mask.shape, dtype=wp.int32, device=device)
    distance = wp.empty(mask.size, dtype=wp.float32, device=device)
    launch_in_bands(find_aside, [mask], [aside], mask.size, device)
    launch_in_bands(find_distance, [aside], [distance], mask.size, device)
    return distance


@forward_kernel
def find_aside(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    mask: wp.array2d(dtype=wp.uint8),
    # output
    aside: wp.array2d(dtype=wp.int32),
):
    """How many columns each pixel is from the mask in its own row, at most `REACH`."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / mask.shape[1]
        column = index - row * mask.shape[1]
        least = wp.int32(REACH)
        for other in range(wp.max(column - REACH, 0), wp.min(column + REACH + 1, mask.shape[1])):
            if mask[row, other] != wp.uint8(0):
                least = wp.min(least, wp.abs(other - column))
        aside[row, column] = least


@forward_kernel
def find_distance(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    aside: wp.array2d(dtype=wp.int32),
    # output
    distance: wp.array(dtype=wp.float32),
):
    """The length of the shortest way of straight and slanted steps: in each row it begins at the nearest pixel."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / aside.shape[1]
        column = index - row * aside.shape[1]
        least = wp.float32(2 * REACH)
        for other in range(wp.max(row - REACH, 0), wp.min(row + REACH + 1, aside.shape[0])):
            away = wp.abs(other - row)
            slanted = wp.min(away, aside[other, column])
            straight = wp.max(away, aside[other, column]) - slanted
            least = wp.min(least, STRAIGHT * wp.float32(straight) + SLANTED * wp.float32(slanted))
        distance[index] = least


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
    segmentation: wp.array2d(dtype=wp.uint8),
    over: wp.array(dtype=wp.bool),
    # output
    ground: wp.array2d(dtype=wp.vec3ub),
):
    """A run of the box's pixels begin .. end - 1; `outside` is how far each is from the silhouette [pixel]."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        window = wp.clamp(1.25 - 1.25 * outside[index] / wp.float32(SURROUND), 0.0, 1.0)
        row = index / width
        column = index - row * width
        if window > 0.0 and not over[wp.int32(segmentation[top + row, left + column])]:
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

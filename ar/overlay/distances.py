"""How far points, and what is seen at pixels, are from a closed surface: by a tree of its triangles, on any device."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..optics.camera import Camera
from ..rendering.parallel import forward_kernel, launch_in_bands, load

# Rays that say whether a point is inside: an odd number, so that they are never of two minds.
RAYS = wp.constant(3)


def tree_of(vertices: np.ndarray, triangles: np.ndarray, device: str = "cpu") -> wp.Mesh:
    """A tree of the triangles (F, 3) of vertices (V, 3) [m]."""
    points = wp.array(vertices, dtype=wp.vec3f, device=device)
    return wp.Mesh(points, wp.array(np.asarray(triangles, np.int32).ravel(), dtype=wp.int32, device=device))


def signed_distance(tree: wp.Mesh, points: np.ndarray, reach: float) -> np.ndarray:
    """(n,) float32 [m] from points (n, 3) [m] to a closed surface, negative inside; NaN beyond `reach` [m]."""
    device = str(tree.device)
    load(device, __name__)
    at = wp.array(points, dtype=wp.vec3f, device=device)
    found = wp.empty(len(points), dtype=wp.float32, device=device)
    launch_in_bands(measure_points, [tree.id, at, float(reach)], [found], len(points), device)
    return found.numpy()


def distance_of_seen(
    tree: wp.Mesh, camera: Camera, box: tuple[slice, slice], depth: wp.array, where: np.ndarray, reach: float
) -> np.ndarray:
    """How far what is seen at each pixel of a box is from a surface: (h, w) float32 [m].

    NaN beyond `reach` [m], and where `where` (h, w) bool is false.

    Parameters
    ----------
    camera, depth
        Of the whole picture; z in the camera frame, (H, W) float32 [m] on the surface's device.
    box
        Rows and columns.
    """
    device = str(tree.device)
    load(device, __name__)
    rows, columns = box
    rays = np.concatenate([camera.straight[rows, columns], np.ones((*where.shape, 1))], axis=2)
    turn = camera.T_camera_world[:3, :3].T @ np.linalg.inv(camera.K)
    found = wp.empty(where.shape, dtype=wp.float32, device=device)
    inputs = [
        tree.id, rows.start, columns.start, wp.array(rays @ turn.T, dtype=wp.vec3f, device=device),
        wp.vec3f(camera.centre), depth, wp.array(np.ascontiguousarray(where).view(np.uint8), device=device),
        float(reach),
    ]  # fmt: skip
    launch_in_bands(measure_seen, inputs, [found], found.size, device, bands=4)
    return found.numpy()


@forward_kernel
def measure_points(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    tree: wp.uint64,
    points: wp.array(dtype=wp.vec3f),
    reach: wp.float32,
    # output
    distance: wp.array(dtype=wp.float32),
):
    """A run of points."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        found = wp.mesh_query_point_sign_parity(tree, points[index], reach, RAYS)
        distance[index] = wp.nan
        if found.result:
            nearest = wp.mesh_eval_position(tree, found.face, found.u, found.v)
            distance[index] = found.sign * wp.length(points[index] - nearest)


@forward_kernel
def measure_seen(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    tree: wp.uint64,
    top: wp.int32,
    left: wp.int32,
    rays: wp.array2d(dtype=wp.vec3f),
    centre: wp.vec3f,
    depth: wp.array2d(dtype=wp.float32),
    where: wp.array2d(dtype=wp.uint8),
    reach: wp.float32,
    # output
    distance: wp.array2d(dtype=wp.float32),
):
    """A run of the box's pixels; `rays` reach to where z is 1."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / distance.shape[1]
        column = index - row * distance.shape[1]
        distance[row, column] = wp.nan
        far = depth[top + row, left + column]
        if where[row, column] != wp.uint8(0) and far > 0.0:
            point = centre + far * rays[row, column]
            found = wp.mesh_query_point_no_sign(tree, point, reach)
            if found.result:
                nearest = wp.mesh_eval_position(tree, found.face, found.u, found.v)
                distance[row, column] = wp.length(point - nearest)

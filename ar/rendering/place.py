"""Where surfaces lie in each picture: projected into camera and lamp, with their normals, in one launch."""

from __future__ import annotations

import numpy as np
import warp as wp

from .parallel import forward_kernel
from .shade_structs import Placed


def faces_around(triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The faces at each of `count` vertices: where each one's begin (count + 1,), and the faces (3 F,), int32."""
    corners = triangles.reshape(-1)
    begins = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=count))])
    return begins.astype(np.int32), (np.argsort(corners, kind="stable") // 3).astype(np.int32)


@wp.func
def place_of(
    picture: wp.int32, vertex: wp.int32, still: wp.array(dtype=wp.vec3d), moved: wp.array2d(dtype=wp.vec3d)
) -> wp.vec3d:
    """Where a vertex is [m]: those that stand still come first."""
    if vertex < still.shape[0]:
        return still[vertex]
    return moved[picture, vertex - still.shape[0]]


@wp.func
def projected(P: wp.mat44d, x: wp.vec3d) -> wp.vec3d:
    """Homogeneous pixel coordinates (u w, v w, w)."""
    q = P * wp.vec4d(x[0], x[1], x[2], wp.float64(1.0))
    return wp.vec3d(q[0], q[1], q[2])


@forward_kernel
def place(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    since: wp.int32,
    still: wp.array(dtype=wp.vec3d),
    moved: wp.array2d(dtype=wp.vec3d),
    cameras: wp.array(dtype=wp.mat44d),
    lamp: wp.mat44d,
    triangles: wp.array(dtype=wp.vec3i),
    around: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.int32),
    # output
    placed: Placed,
):
    """Each vertex from number `since` on, in each picture; normals are the faces' weighted by area."""
    start = begin + wp.tid() * run
    each = placed.seen.shape[1] - since
    for index in range(start, wp.min(start + run, end)):
        picture = index / each
        vertex = since + index - picture * each
        x = place_of(picture, vertex, still, moved)
        placed.seen[picture, vertex] = projected(cameras[picture], x)
        placed.lit[picture, vertex] = projected(lamp, x)
        placed.vertices[picture, vertex] = wp.vec3f(x)
        normal = wp.vec3d(wp.float64(0.0))
        for k in range(around[vertex], around[vertex + 1]):
            t = triangles[faces[k]]
            a = place_of(picture, t[0], still, moved)
            normal += wp.cross(place_of(picture, t[1], still, moved) - a, place_of(picture, t[2], still, moved) - a)
        length = wp.length(normal)
        if length > wp.float64(0.0):
            normal /= length
        placed.normals[picture, vertex] = wp.vec3f(normal)

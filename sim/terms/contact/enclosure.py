"""Test if points are inside a closed surface, for a batch of deformed surfaces.

The test uses solid angles: van Oosterom, Strackee 1983, "The solid angle of a plane triangle", IEEE Trans.
Biomed. Eng. 30:125-126, equation 8.
"""

from functools import cache

import numpy as np
import warp as wp

from ...runtime.device import Device, forward_kernel


@cache
def build_kernel(device: Device) -> wp.Kernel:
    """Return the solid angle kernel, launched over (triangle, load case)."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def add_angle(
        points: wp.array2d(dtype=wp.vec3d),
        nodes: wp.array(dtype=wp.vec3d),
        triangles: wp.array2d(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Add half of the solid angle [sr] of a triangle, as seen from points (p, b)."""
        s, c = wp.tid()
        corners = wp.mat33d()
        for row in range(3):
            i = triangles[s, row]
            for k in range(3):
                corners[row, k] = nodes[i][k] + wp.float64(u[3 * i + k, c])
        for p in range(points.shape[0]):
            x, y, z = corners[0] - points[p, c], corners[1] - points[p, c], corners[2] - points[p, c]
            a, b, d = wp.length(x), wp.length(y), wp.length(z)
            along = a * b * d + wp.dot(x, y) * d + wp.dot(y, z) * a + wp.dot(z, x) * b
            wp.atomic_add(out, p, c, wp.atan2(wp.dot(x, wp.cross(y, z)), along))

    return add_angle


def find_enclosing_columns(
    device: Device, points: np.ndarray, nodes: wp.array, triangles: wp.array, u: wp.array
) -> np.ndarray:
    """Return a mask (b,) of load cases with a point (b, p, 3) [m] inside the outward surface displaced by u (3N, b)."""
    points = np.ascontiguousarray(points.swapaxes(0, 1))
    angle = wp.zeros(points.shape[:2], dtype=wp.float64, device=device.name)
    inputs = [device.upload(points, wp.vec3d), nodes, triangles, u]
    device.launch(build_kernel(device), (len(triangles), points.shape[1]), inputs, [angle])
    return (angle.numpy() > np.pi).any(axis=0)

"""Points of triangles nearest to the core of a rigid tool, and their distances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import warp as wp

from ..runtime.device import forward_kernel, load_module
from .footprint import find_nearest_on_triangle

# Number of alternating projections between a triangle and an extended core.
PROJECTION_ITERATIONS = 16


class NearestPoints(NamedTuple):
    """Nearest points on S triangles: `barycentric` (S, 3), `distance` (S,) [m], `normal` (S, 3) away from the core."""

    barycentric: np.ndarray
    distance: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True, eq=False)
class PlacedBox:
    """Core of a tool at its pose: a box, which is a point for a ball and a line for a rod.

    The flat core of a blade touches only tissue below the blade: the penetration depth is the height above the core.

    `centre` (3,) [m]; `axes` (3, 3), one axis per column; `half_sizes` (3,) [m].
    """

    centre: np.ndarray
    axes: np.ndarray
    half_sizes: np.ndarray

    def move(self, translation: np.ndarray) -> PlacedBox:
        """Return the box moved by `translation` (3,) [m]."""
        return replace(self, centre=self.centre + translation)

    @property
    def corners(self) -> np.ndarray:
        """Corners (8, 3) [m] of the box."""
        signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        return self.centre + (signs * self.half_sizes) @ self.axes.T

    def find_nearest(self, corners: np.ndarray) -> NearestPoints:
        """Return, on each triangle with `corners` (S, 3, 3) [m], the point nearest to the box.

        The method is alternating projection with momentum (Beck, Teboulle 2009, "A fast iterative
        shrinkage-thresholding algorithm", SIAM J. Imaging Sci. 2:183-202, equations 4.1 to 4.3).
        """
        return NearestSearch(len(corners)).find_nearest(self, corners)

    def compute_distances(self, corners: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances (n,) [m] and directions (n, 3) from the box to points of barycentric coordinates (n, 3)."""
        place = np.einsum("nc,nci->ni", barycentric, corners) - self.centre
        local = place @ self.axes
        away = place - np.clip(local, -self.half_sizes, self.half_sizes) @ self.axes.T
        distance = np.sqrt(np.einsum("ni,ni->n", away, away))
        normal = away / np.maximum(distance, np.finfo(float).tiny)[:, None]
        if self.half_sizes[2] == 0.0 and self.half_sizes[:2].all():
            through = (np.abs(local[:, :2]) <= self.half_sizes[:2]).all(axis=1) & (local[:, 2] >= 0.0)
            return np.where(through, -local[:, 2], distance), np.where(through[:, None], -self.axes[:, 2], normal)
        return distance, normal


class NearestSearch:
    """Nearest point search on a fixed number of triangles, with reused arrays."""

    def __init__(self, count: int):
        self._corners = np.empty((count, 3, 3))
        self._found = NearestPoints(np.empty((count, 3)), np.empty(count), np.empty((count, 3)))
        load_module(_find_nearest.module)
        kinds = (wp.vec3d, wp.vec3d, wp.float64, wp.vec3d)
        given = zip((self._corners, *self._found), kinds, strict=True)
        arrays = [wp.array(each, dtype=kind, device="cpu", copy=False) for each, kind in given]
        stands = [wp.vec3d(), wp.mat33d(), wp.vec3d(), 1]
        # A recorded launch costs a tenth of another one.
        self._launch = wp.launch(
            _find_nearest, count, [arrays[0], *stands], arrays[1:], device="cpu", record_cmd=True, record_tape=False
        )

    def find_nearest(self, core: PlacedBox, corners: np.ndarray) -> NearestPoints:
        """Return the result of `PlacedBox.find_nearest`; this overwrites the arrays of the previous result."""
        if self._launch is None:  # no triangles
            return self._found
        self._corners[:] = corners
        stands = wp.vec3d(*core.centre), wp.mat33d(*core.axes.ravel()), wp.vec3d(*core.half_sizes)
        for number, value in enumerate([*stands, PROJECTION_ITERATIONS if core.half_sizes.any() else 1], 1):
            self._launch.set_param_at_index(number, value)
        self._launch.launch()
        return self._found


@forward_kernel
def _find_nearest(
    corners: wp.array2d(dtype=wp.vec3d),
    centre: wp.vec3d,
    axes: wp.mat33d,
    half_sizes: wp.vec3d,
    iterations: int,
    barycentric: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    normal: wp.array(dtype=wp.vec3d),
):
    """Iterate y = x + (t - 1) / t' (x - x'); x is the triangle point nearest to the box point that is nearest to y.

    The momentum parameter is t' = (1 + sqrt(1 + 4 t^2)) / 2.
    """
    face = wp.tid()
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    one, pace = wp.float64(1.0), wp.float64(1.0)
    place = (a + b + c) / wp.float64(3.0)
    ahead = wp.vec3d(place)  # copies, since plain assignment would alias
    for _turn in range(iterations):
        last, before = wp.vec3d(place), wp.float64(pace)
        place = find_nearest_on_triangle(a, b, c, _find_nearest_in_box(ahead, centre, axes, half_sizes))
        pace = (one + wp.sqrt(one + wp.float64(4.0) * before * before)) / wp.float64(2.0)
        ahead = place + ((before - one) / pace) * (place - last)
    first, second, offset = b - a, c - a, place - a
    aa, ab, bb = wp.dot(first, first), wp.dot(first, second), wp.dot(second, second)
    pa, pb = wp.dot(offset, first), wp.dot(offset, second)
    area = wp.max(aa * bb - ab * ab, wp.float64(1.0e-300))
    v = wp.clamp((bb * pa - ab * pb) / area, wp.float64(0.0), one)
    w = wp.clamp((aa * pb - ab * pa) / area, wp.float64(0.0), one - v)
    barycentric[face] = wp.vec3d(one - v - w, v, w)
    away = place - _find_nearest_in_box(place, centre, axes, half_sizes)
    distance[face] = wp.length(away)
    normal[face] = wp.normalize(away)
    down = -wp.vec3d(axes[0, 2], axes[1, 2], axes[2, 2])
    above = _compute_face_height(place, centre, axes, half_sizes)
    if above >= wp.float64(0.0):
        distance[face] = -above
        normal[face] = down
    for corner in range(3):
        above = _compute_face_height(corners[face, corner], centre, axes, half_sizes)
        if above >= wp.float64(0.0) and -above < distance[face]:
            distance[face] = -above
            normal[face] = down
            weight = wp.vec3d()
            weight[corner] = one
            barycentric[face] = weight


@wp.func
def _compute_face_height(point: wp.vec3d, centre: wp.vec3d, axes: wp.mat33d, sizes: wp.vec3d) -> wp.float64:
    """Return the height of a point above a flat box if the point is over the upper face; else -1."""
    none = wp.float64(0.0)
    local = wp.transpose(axes) @ (point - centre)
    within = wp.abs(local[0]) <= sizes[0] and wp.abs(local[1]) <= sizes[1] and local[2] >= none
    return wp.where(within and sizes[2] == none and sizes[0] > none and sizes[1] > none, local[2], wp.float64(-1.0))


@wp.func
def _find_nearest_in_box(point: wp.vec3d, centre: wp.vec3d, axes: wp.mat33d, sizes: wp.vec3d) -> wp.vec3d:
    """Return the point of the box nearest to a point."""
    local = wp.transpose(axes) @ (point - centre)
    for i in range(3):
        local[i] = wp.clamp(local[i], -sizes[i], sizes[i])
    return centre + axes @ local

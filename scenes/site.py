"""The open cortex as a place to work at: a frame on it, and material points of its surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh

from sim.anatomy import Anatomy
from sim.errors import InputError
from surrogate.patch import open_patch

from .paths import Touch

# Radius of the drape's hole over that of the largest circle of open cortex: its rim hides the mesh's ragged border.
HOLE = 0.98


@dataclass(frozen=True, eq=False)
class Contact:
    """A material point of the surface: point (3,) [m] at rest, its triangle's vertices (3,) and weights (3,)."""

    point: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray

    def carried(self, positions: np.ndarray) -> np.ndarray:
        """Where it is (3,) when the mesh's vertices are at positions (V, 3) [m]."""
        return self.weights @ positions[self.vertices]


@dataclass(frozen=True, eq=False)
class Site:
    """Frame of the open cortex.

    origin (3,) [m], on the surface; axis (3,), the mean inward normal; right and up (3,) span the tangent plane.
    """

    anatomy: Anatomy
    origin: np.ndarray
    axis: np.ndarray
    right: np.ndarray
    up: np.ndarray

    @cached_property
    def _surface(self) -> trimesh.Trimesh:
        return trimesh.Trimesh(self.anatomy.mesh.nodes, self.anatomy.open_surface, process=False)

    @cached_property
    def radius(self) -> float:
        """Radius of the circle of the open cortex's area [m]."""
        return float(np.sqrt(self._surface.area / np.pi))

    @cached_property
    def clearance(self) -> float:
        """Radius of the largest circle round the origin, across the axis, that the open cortex fills [m]."""
        patch = open_patch(self.anatomy)
        flat = patch.points - np.outer((patch.points - self.origin) @ self.axis, self.axis)
        return float(replace(patch, points=flat).rim_distance(self.origin[None])[0])

    def reach(self, radius: float) -> float:
        """How far from the line through the origin along the axis the bone lets a tool of this `radius` go [m]."""
        return max(0.0, HOLE * self.clearance - radius)

    def within(self, point: np.ndarray, radius: float) -> np.ndarray:
        """The point (3,) [m], brought back across the axis to where the bone stops a tool of this `radius` [m]."""
        arm = point - self.origin
        aside = arm - (arm @ self.axis) * self.axis
        length = float(np.linalg.norm(aside))
        return point - max(0.0, 1.0 - self.reach(radius) / max(length, np.finfo(float).tiny)) * aside

    def across(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] of points (n, 3) from the line through the origin along the axis."""
        arm = points - self.origin
        return np.linalg.norm(arm - np.outer(arm @ self.axis, self.axis), axis=1)

    def contact(self, x: float, y: float, radius: float) -> Contact:
        """The material point of the open cortex nearest to the place (x, y) [m] of its tangent plane.

        A tool of this `radius` [m] stays inside the opening: the place is brought back to where the bone stops it.
        """
        asked = self.within(self.origin + x * self.right + y * self.up, radius)
        point, _, triangle = trimesh.proximity.closest_point_naive(self._surface, asked[None])
        weights = trimesh.triangles.points_to_barycentric(self._surface.triangles[triangle], point)
        return Contact(point[0], self.anatomy.open_surface[triangle[0]], weights[0])

    def direction(self, touch: Touch) -> np.ndarray:
        """Unit direction (3,) of a touch's force: inwards, tilted."""
        along = self.axis + np.tan(touch.tilt[0]) * self.right + np.tan(touch.tilt[1]) * self.up
        return along / np.linalg.norm(along)


def site_of(anatomy: Anatomy) -> Site:
    """The frame of an anatomy's open cortex; `up` is as superior as the surface allows.

    Raises
    ------
    InputError
        An anatomy without open cortex.
    """
    triangles = anatomy.open_surface
    if len(triangles) == 0:
        raise InputError("this anatomy has no open cortex: make one with `sulcus anatomy --craniotomy 50`.")
    a, b, c = (anatomy.mesh.nodes[triangles[:, corner]] for corner in range(3))
    area = 0.5 * np.cross(b - a, c - a)
    axis = -area.sum(axis=0) / np.linalg.norm(area.sum(axis=0))
    size = np.linalg.norm(area, axis=1)
    middle = (size @ (a + b + c)) / (3.0 * size.sum())
    surface = trimesh.Trimesh(anatomy.mesh.nodes, triangles, process=False)
    origin = trimesh.proximity.closest_point_naive(surface, middle[None])[0][0]
    # Superior, or anterior where the craniotomy looks straight up.
    reference = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(axis, reference)
    right /= np.linalg.norm(right)
    return Site(anatomy, origin, axis, right, np.cross(right, axis))

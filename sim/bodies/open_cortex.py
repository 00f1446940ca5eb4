"""Exposed cortex of an anatomy: local coordinate system, craniotomy edge, and contact points of a tool."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..anatomy import Anatomy
from ..arguments import check_numbers_array
from ..errors import InputError
from ..geometry.closest_point import find_closest_points
from ..geometry.surface import compute_areas, compute_vertex_normals, normalise_vectors

# Distance below which a point counts as on the edge [m].
EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Place:
    """Material point on the exposed cortex.

    Parameters
    ----------
    point
        Undeformed position (3,) [m].
    inward
        Unit normal (3,) of the surface at this point, into the brain.
    vertices, weights
        Mesh vertices (3,) of the triangle that contains the point, and its barycentric weights (3,).
    """

    point: np.ndarray
    inward: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray

    def locate(self, positions: np.ndarray) -> np.ndarray:
        """Return the deformed position (3,) [m], given vertex positions (V, 3) [m]."""
        return self.weights @ positions[self.vertices]

    carried = locate  # Former names, for one release.


@dataclass(frozen=True, eq=False)
class OpenCortex:
    """Exposed cortex of an anatomy, with a local coordinate system.

    Parameters
    ----------
    anatomy
        Anatomy with a craniotomy.
    origin
        Centroid (3,) [m] of the exposed surface, projected onto it.
    axis
        Mean inward normal (3,).
    right, up
        Unit vectors (3,) that span the tangent plane; `up` is the most superior tangent direction.
    """

    anatomy: Anatomy
    origin: np.ndarray
    axis: np.ndarray
    right: np.ndarray
    up: np.ndarray

    @cached_property
    def corners(self) -> np.ndarray:
        """Corner positions (S, 3, 3) [m] of the triangles of the exposed cortex."""
        return self.anatomy.mesh.nodes[self.anatomy.open_surface]

    @cached_property
    def radius(self) -> float:
        """Radius of the circle with the same area as the exposed cortex [m]."""
        return float(np.sqrt(compute_areas(self.corners).sum() / np.pi))

    @cached_property
    def clearance(self) -> float:
        """Radius of the largest circle [m] inside the exposed cortex, around the origin, perpendicular to the axis."""
        rim = find_border_edges(self.anatomy.mesh.nodes, self.anatomy.open_surface) - self.origin
        return float(compute_edge_distances(rim - (rim @ self.axis)[..., None] * self.axis, np.zeros((1, 3)))[0])

    @cached_property
    def _inward(self) -> np.ndarray:
        return -compute_vertex_normals(self.anatomy.mesh.nodes, self.anatomy.open_surface)

    def compute_axis_distance(self, points: np.ndarray) -> np.ndarray:
        """Return distances (n,) [m] of points (n, 3) from the line through the origin along the axis."""
        arm = points - self.origin
        return np.linalg.norm(arm - np.outer(arm @ self.axis, self.axis), axis=1)

    def find_nearest(self, point: np.ndarray) -> Place:
        """Return the point of the exposed cortex nearest to `point` (3,) [m]."""
        at, triangle, weights = (found[0] for found in find_closest_points(point[None], self.corners))
        vertices = self.anatomy.open_surface[triangle]
        return Place(at, normalise_vectors((weights @ self._inward[vertices])[None])[0], vertices, weights)

    def place(self, right_mm: float = 0.0, up_mm: float = 0.0) -> Place:
        """Return the point of the exposed cortex at a tangential offset from the origin, to the right and up [mm].

        Raises
        ------
        InputError
            A value is not a finite number, or the point is outside the exposed cortex.
        """
        for name, value in (("right_mm", right_mm), ("up_mm", up_mm)):
            given = check_numbers_array(name, value)
            if given.shape != ():
                raise InputError(f"{name} has shape {given.shape}: give one number, in millimetres.")
        found = self.find_nearest(self.origin + 1e-3 * (right_mm * self.right + up_mm * self.up))
        rim = find_border_edges(self.anatomy.mesh.nodes, self.anatomy.open_surface)
        if not compute_edge_distances(rim, found.point[None])[0] > EDGE_TOLERANCE:
            raise InputError(
                f"the place {right_mm:g} mm right, {up_mm:g} mm up lies outside the open cortex: stay within "
                f"{1e3 * self.clearance:.3g} mm of its middle, or open the skull wider with --craniotomy."
            )
        return found

    across, nearest = compute_axis_distance, find_nearest  # Former names, for one release.


def open_cortex(anatomy: Anatomy) -> OpenCortex:
    """Return the exposed cortex of an anatomy with its coordinate system.

    Raises
    ------
    InputError
        The anatomy has no exposed cortex.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import open_cortex, read_anatomy
    >>> cortex = open_cortex(read_anatomy(get_template_path()))
    >>> round(1e3 * cortex.radius, 1), cortex.place(right_mm=5, up_mm=0).inward.round(1).tolist()  # [mm], [1]
    (22.8, [-0.7, -0.2, -0.7])
    """
    triangles = anatomy.open_surface
    if len(triangles) == 0:
        raise InputError("this anatomy has no open cortex: make one with `sulcus anatomy --craniotomy 50`.")
    corners = anatomy.mesh.nodes[triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    area = 0.5 * np.cross(b - a, c - a)
    axis = -area.sum(axis=0) / np.linalg.norm(area.sum(axis=0))
    size = np.linalg.norm(area, axis=1)
    middle = (size @ (a + b + c)) / (3.0 * size.sum())
    # superior, or anterior if the craniotomy faces up or down
    reference = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(axis, reference)
    right /= np.linalg.norm(right)
    return OpenCortex(anatomy, find_closest_points(middle[None], corners).point[0], axis, right, np.cross(right, axis))


def find_border_edges(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the edges (E, 2, 3) [m] that belong to exactly one of the `triangles` (S, 3), with `points` (V, 3) [m]."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return points[edges[count == 1]]


def compute_edge_distances(edges: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return distances (B,) [m] from `points` (B, 3) to the nearest of `edges` (E, 2, 3)."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    offset, square = points[:, None] - start, np.einsum("ei,ei->e", along, along)
    share = np.einsum("bei,ei->be", offset, along) / np.where(square > 0.0, square, 1.0)
    offset -= np.clip(share, 0.0, 1.0)[:, :, None] * along
    return np.sqrt(np.einsum("bei,bei->be", offset, offset).min(axis=1))

"""Open cortex as a surface for sampling: areas, inward normals, and the edge that no footprint may cross."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import compute_edge_distances, find_border_edges
from sim.errors import InputError
from sim.geometry.surface import compute_areas, compute_vertex_normals

from ..array_functions import compute_squared_distances, take_rows

if TYPE_CHECKING:
    from sim.discretisation.footprint import ContactSurface


def build_barycentric_lattice(subdivisions: int) -> np.ndarray:
    """Compute barycentric coordinates (n^2, 3) of the centres of n^2 equal subtriangles; n is `subdivisions`."""
    upright = [(i + 1.0 / 3.0, j + 1.0 / 3.0) for i in range(subdivisions) for j in range(subdivisions - i)]
    turned = [(i + 2.0 / 3.0, j + 2.0 / 3.0) for i in range(subdivisions - 1) for j in range(subdivisions - 1 - i)]
    share = np.array(upright + turned) / subdivisions
    return np.column_stack([1.0 - share.sum(axis=1), share])


@dataclass(frozen=True, eq=False)
class Patch:
    """Open cortex: the triangles of `Anatomy.open_surface`.

    Parameters
    ----------
    nodes
        Sorted mesh vertices (m,) of the patch, which are those that a footprint inside the patch loads.
    triangles
        Triangles (S, 3) as indices into `nodes`, oriented outwards.
    points
        Positions (m, 3) [m] of `nodes`, RAS.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    points: np.ndarray

    @cached_property
    def areas(self) -> np.ndarray:
        """Triangle areas (S,) [m^2]."""
        return compute_areas(self.points[self.triangles])

    @cached_property
    def normals(self) -> np.ndarray:
        """Area-weighted unit inward normals (m, 3) at the nodes."""
        return -compute_vertex_normals(self.points, self.triangles)

    @cached_property
    def contact_surface(self) -> ContactSurface:
        """Contact surface of the patch, on the CPU, for footprints and nearest points."""
        # Warp is imported only for pressing tools, not for reading a model.
        from sim.discretisation.footprint import ContactSurface
        from sim.runtime.device import find_device

        return ContactSurface(self.points, self.triangles, find_device("cpu", "float64"), "open cortex")

    @cached_property
    def boundary_edges(self) -> np.ndarray:
        """End points (E, 2, 3) [m] of the edges that belong to one triangle only."""
        return find_border_edges(self.points, self.triangles)

    def compute_edge_distance(self, points: np.ndarray) -> np.ndarray:
        """Compute the distances (B,) [m] of `points` (B, 3) from the patch's edge."""
        return compute_edge_distances(self.boundary_edges, points)

    def place_points(self, random_numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map uniform random numbers (n, 3) to area-uniform points (n, 3) [m] and their unit inward normals (n, 3)."""
        total = np.cumsum(self.areas)
        triangle = self.triangles[np.searchsorted(total, random_numbers[:, 0] * total[-1], side="right")]
        root = np.sqrt(random_numbers[:, 1])
        share = np.stack([1.0 - root, root * (1.0 - random_numbers[:, 2]), root * random_numbers[:, 2]], axis=1)
        point, normal = (np.einsum("nc,nci->ni", share, field[triangle]) for field in (self.points, self.normals))
        return point, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def find_normals(self, points: np.ndarray) -> np.ndarray:
        """Return the unit inward normals (B, 3) at the nodes nearest to `points` (B, 3) [m]."""
        return take_rows(compute_squared_distances(points, self.points).argmin(axis=1), self.normals)

    def compute_coverage(self, centres: np.ndarray, radius: float) -> float:
        """Compute the area share within `radius` [m] of any of the `centres` (k, 3) [m], by 16 points a triangle."""
        share = build_barycentric_lattice(4)
        samples = np.einsum("qc,scx->sqx", share, self.points[self.triangles])
        inside = find_nearest(samples.reshape(-1, 3), centres)[1].reshape(len(samples), -1) <= radius
        return float(inside.mean(axis=1) @ self.areas / self.areas.sum())


def open_patch(anatomy: Anatomy) -> Patch:
    """Build the open cortex of an anatomy.

    Raises
    ------
    InputError
        No triangle of the surface is completely inside the craniotomy.
    """
    if not len(anatomy.open_surface):
        raise InputError("the anatomy has no open cortex for a tool to touch: make one with a wider --craniotomy.")
    nodes, triangles = np.unique(anatomy.open_surface, return_inverse=True)
    return Patch(nodes, triangles, anatomy.mesh.nodes[nodes])


def find_nearest(points: np.ndarray, sites: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return index (B,) and distance (B,) of the nearest of the `sites` (n, 3) to each of the `points` (B, 3)."""
    squared = compute_squared_distances(points, sites)
    return squared.argmin(axis=1), np.sqrt(squared.min(axis=1))

"""Nodes and elements of an element type on a mesh; the mesh vertices are the first nodes."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse as sp

from ..elements import ELEMENTS, OTHER_METHODS, RECOMMENDED
from ..errors import InputError
from ..geometry.surface import normalise_vectors
from ..geometry.tetmesh import QUADRATIC_EDGES, TRIANGLE_EDGES, TetMesh, compute_row_keys
from .element import Elements, build_linear_elements, build_quadratic_elements
from .element_free import build_element_free
from .smoothed import build_edge_elements, build_node_elements


@dataclass(frozen=True, eq=False)
class ElementPart:
    """Set of elements, and the part of the stiffness that these elements have: "whole", "shape" or "volume"."""

    elements: Elements
    portion: str


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Discretisation with N nodes: V mesh vertices, then one node on each of `edges` (E, 2) for quadratic elements.

    `table` (T, n): node numbers of the tetrahedra, the corners and, if quadratic, the midpoints of `QUADRATIC_EDGES`.
    """

    mesh: TetMesh
    element: str
    table: np.ndarray
    edges: np.ndarray

    @property
    def count(self) -> int:
        """Number of nodes N."""
        return len(self.mesh.nodes) + len(self.edges)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Undeformed positions (N, 3) [m]."""
        return self.interpolate_field(self.mesh.nodes)

    @property
    def keys(self) -> np.ndarray:
        """Unique key (N, 2) of each node, also after resection: its vertex number twice, or the ends of its edge."""
        return np.concatenate([np.repeat(np.arange(len(self.mesh.nodes))[:, None], 2, axis=1), self.edges])

    @cached_property
    def corner_interpolation(self) -> sp.csr_array:
        """Interpolation matrix (N, C) from the C corner nodes to all nodes, linear along each edge."""
        corner, place = np.unique(self.table[:, :4]), np.zeros(self.count, np.int64)
        place[corner] = np.arange(len(corner))
        middle, first = np.unique(self.table[:, 4:], return_index=True)
        ends = self.table[:, QUADRATIC_EDGES].reshape(-1, 2)[first]
        row = np.concatenate([corner, np.repeat(middle, 2)])
        column = place[np.concatenate([corner, ends.ravel()])]
        value = np.repeat([1.0, 0.5], [len(corner), 2 * len(middle)])
        return sp.csr_array(sp.coo_array((value, (row, column)), shape=(self.count, len(corner))))

    @cached_property
    def surface(self) -> np.ndarray:
        """Surface triangles (S, 3) or, if quadratic, (S, 6): corners, then midpoints of `TRIANGLE_EDGES`."""
        corners = self.mesh.surface
        if self.table.shape[1] == 4:
            return corners
        ends, wanted = self.table[:, QUADRATIC_EDGES].reshape(-1, 2), corners[:, TRIANGLE_EDGES].reshape(-1, 2)
        known, asked = np.split(compute_row_keys(np.vstack([ends, wanted])), [len(ends)])
        key, first = np.unique(known, return_index=True)
        middles = self.table[:, 4:].ravel()[first[np.searchsorted(key, asked)]]
        return np.column_stack([corners, middles.reshape(-1, 3)])

    def build_elements(self, tet_mask: np.ndarray) -> tuple[ElementPart, ...]:
        """Return the elements on the tetrahedra in `tet_mask` (T,).

        Raises
        ------
        InputError
            A quadratic element is folded.
        """
        if self.element == "p1":
            return (ElementPart(build_linear_elements(self.mesh, tet_mask), "whole"),)
        if self.element == "springs":
            return (ElementPart(build_linear_elements(self.mesh, tet_mask), "springs"),)
        if self.element == "p2":
            return (ElementPart(build_quadratic_elements(self.nodes, self.table, tet_mask), "whole"),)
        return _build_averaged_parts(self.mesh, self.element, tet_mask.tobytes())

    def extend_fixed(self, fixed: np.ndarray) -> np.ndarray:
        """Return the mask (N, 3) of fixed components of all nodes, from the mask (V, 3) of the mesh vertices.

        An added node is fixed if its edge belongs to a surface triangle whose corners are all fixed.
        """
        out = np.zeros((self.count, 3), bool)
        out[: len(fixed)] = fixed
        for component in range(3):
            wall = self.surface[fixed[self.mesh.surface, component].all(axis=1), 3:]
            out[wall[wall >= len(fixed)], component] = True
        return out

    def extend_normals(self, normal: np.ndarray, fixed: np.ndarray, min_cosine: float = 0.75) -> np.ndarray:
        """Return the slide normals (N, 3) of all nodes, from `normal` (V, 3) and `fixed` (V, 3) of the mesh vertices.

        An added node slides if its edge belongs to a surface triangle whose corners all slide or are fixed. Its normal
        is the integral of the gradient of its shape function, so that no volume passes through the surface. If this
        normal deviates from the normals at the ends of the edge, as at the edge of a box, the integral includes only
        sliding triangles. Normals deviate if their cosine is at most `min_cosine`.
        """
        out = np.zeros((self.count, 3))
        out[: len(normal)] = normal
        if not len(self.edges):
            return out
        corners, slides = self.mesh.surface, (normal != 0.0).any(axis=1)
        wall = (slides | fixed.all(axis=1))[corners].all(axis=1) & slides[corners].any(axis=1)
        a, b, c = np.moveaxis(self.mesh.nodes[corners], 1, 0)
        twice = np.cross(b - a, c - a)
        near, every = np.zeros_like(out), np.zeros_like(out)
        np.add.at(near, self.surface[wall, 3:], twice[wall, None])
        np.add.at(every, self.surface[:, 3:], twice[:, None])
        near, every = normalise_vectors(near[len(normal) :]), normalise_vectors(every[len(normal) :])
        agrees = (np.einsum("nei,ni->ne", normal[self.edges], every) > min_cosine) | ~slides[self.edges]
        found = np.where(agrees.all(axis=1, keepdims=True), every, near)
        out[len(normal) :] = np.where((near != 0.0).any(axis=1, keepdims=True), found, 0.0)
        return out

    def interpolate_field(self, field: np.ndarray) -> np.ndarray:
        """Return a field (..., V, 3) interpolated to all nodes (..., N, 3), linear along each edge."""
        return np.concatenate([field, field[..., self.edges, :].mean(axis=-2)], axis=-2)

    def sum_by_vertex(self, field: np.ndarray) -> np.ndarray:
        """Return the transpose of `interpolate_field` applied to values (B, N, 3): values (B, V, 3)."""
        vertices = len(self.mesh.nodes)
        out = np.moveaxis(field, 1, 0)[:vertices].copy()
        for end in self.edges.T:
            np.add.at(out, end, 0.5 * np.moveaxis(field, 1, 0)[vertices:])
        return np.moveaxis(out, 0, 1)


@lru_cache(2)  # shared by effects, tissues and diagnostics: 10 % of a locator's set-up on a GPU
def _build_averaged_parts(mesh: TetMesh, element: str, mask_bytes: bytes) -> tuple[ElementPart, ...]:
    """Return smoothed or element-free elements on the tetrahedra of a mask (T,), given as bytes."""
    tets = np.frombuffer(mask_bytes, bool)
    if element == "element-free":
        return (ElementPart(build_element_free(mesh, tets), "whole"),)
    return ElementPart(build_edge_elements(mesh, tets), "shape"), ElementPart(build_node_elements(mesh, tets), "volume")


def recommend_element(mesh: TetMesh) -> str:
    """Return the name of the default element: `RECOMMENDED`, or p2 for a mesh with mid-edge nodes."""
    return RECOMMENDED if mesh.middles is None else "p2"


def discretise(mesh: TetMesh, element: str | None = None) -> Discretisation:
    """Return the discretisation of a mesh by the type `element`, a name in `ELEMENTS` or `OTHER_METHODS`.

    If `element` is None, `recommend_element` chooses the type.

    Raises
    ------
    InputError
        The type is unknown, or is linear although the mesh has mid-edge nodes.
    """
    element = recommend_element(mesh) if element is None else element
    if element not in (*ELEMENTS, *OTHER_METHODS):  # tuple, since `element` may be unhashable
        raise InputError(f"no element is called {element!r}: choose one of {', '.join((*ELEMENTS, *OTHER_METHODS))}.")
    none = np.zeros((0, 2), np.int32)
    if mesh.middles is not None:
        if element != "p2":
            raise InputError(f"the mesh has quadratic tetrahedra, not {element}: use p2, or a linear mesh.")
        return Discretisation(mesh, element, mesh.table, none)
    if element != "p2":
        return Discretisation(mesh, element, mesh.tets, none)
    ends = np.sort(mesh.tets[:, QUADRATIC_EDGES].reshape(-1, 2), axis=1)
    _, first, place = np.unique(compute_row_keys(ends), return_index=True, return_inverse=True)
    middles = len(mesh.nodes) + place.reshape(-1, 6).astype(np.int32)
    return Discretisation(mesh, element, np.hstack([mesh.tets, middles]), ends[first])

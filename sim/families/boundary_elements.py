"""Direct boundary element method (BEM) of linear elasticity, for brain and tumour as two coupled regions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial import KDTree

from ..anatomy import describe_region
from ..arguments import check_vertex_numbers
from ..errors import InputError
from ..geometry.surface import compute_vertex_areas
from ..geometry.tetmesh import TRIANGLE_EDGES, compute_row_keys, find_boundary_faces
from .kelvin_integrals import integrate_triangles
from .linear_body import LinearBody

CHUNK = 8  # Collocation points whose integrals are computed together.


@dataclass(frozen=True, eq=False)
class _Region:
    """Region of uniform tissue, with its boundary.

    `members` (n,) are its vertices, `triangles` (S, 3) its outward boundary by vertex numbers. Triangle corners are
    summed to unknown displacements by `motion_sums` (u, 3 S), to tractions, forces by `traction_sums` (t, 3 S).
    """

    nodes: np.ndarray
    members: np.ndarray
    triangles: np.ndarray
    lame: tuple[float, float]
    motion_sums: sp.csr_array
    traction_sums: sp.csr_array

    def integrate(self, vertices: np.ndarray, column: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield boundary integrals for loads at the `vertices` (n,) of the region, for a few vertices at a time.

        `column` (n,) is the unknown displacement of the nearest boundary vertex, or -1 if this vertex is fixed. Its
        coefficient follows from a rigid motion without tractions. Each item has p vertices, and H (3 p, 3 u) and
        G (3 p, 3 t) of Somigliana's identity: u = G t - H u inside, 0 = G t - H u on the boundary.
        """
        inside = ~np.isin(vertices, self.triangles)
        for first in range(0, len(vertices), CHUNK):
            some = slice(first, first + CHUNK)
            count = len(vertices[some])
            corners = self.nodes[self.triangles] - self.nodes[vertices[some], None, None]
            blocks = integrate_triangles(corners.reshape(-1, 3, 3), self.lame[1] / (2.0 * sum(self.lame)))
            blocks = blocks.reshape(count, -1, 2, 3, 9).transpose(2, 1, 3, 0, 4).reshape(2, -1, count, 9)
            total = blocks[1].sum(axis=0) + inside[some, None] * np.eye(3).ravel()
            motion, force = (
                (matrix @ each.reshape(-1, 9 * count)).reshape(-1, count, 3, 3).transpose(1, 2, 0, 3)
                for matrix, each in ((self.motion_sums, blocks[1]), (self.traction_sums, blocks[0] / self.lame[0]))
            )
            own = np.flatnonzero(column[some] >= 0)
            motion[own, :, column[some][own]] -= total[own].reshape(-1, 3, 3)
            yield vertices[some], motion.reshape(3 * count, -1), force.reshape(3 * count, -1)


def compute_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] of vertices `nodes` (n,) under unit forces at `body.loaded` (a,).

    The second axis is the force direction. The equations are collocated at boundary vertices, with linear displacements
    and tractions on triangles (Brebbia & Dominguez 1992, ch. 4; James & Pai 1999 for simulated surgery). Between brain
    and tumour, displacements are continuous and tractions are in equilibrium. Triangles of the free surface are divided
    into four. A unit force acts as the traction of the dual shape function of its vertex, 4 N_a - 1 on each undivided
    triangle, with the force, moment and work of nodal forces (Wohlmuth 2000).

    Raises
    ------
    InputError
        Brain or tumour have more than one tissue. A fixed vertex is in the interior or at the tumour, or no triangle is
        fixed. A force acts at a vertex that is not on the free surface. The mesh does not have a vertex.
    """
    nodes = check_vertex_numbers("nodes", nodes, len(body.fixed))
    regions, move, pull = _build_regions(body)
    moved, pulled, loads = 3 * (move.max() + 1), 3 * (pull.max() + 1), 3 * len(body.loaded)
    matrix, load, row = np.empty((moved + pulled, moved + pulled), order="F"), np.empty((moved + pulled, loads)), 0
    for region in regions:
        vertices = np.unique(region.triangles)
        vertices = vertices[(move[vertices] >= 0) | (pull[vertices] >= 0)]
        for _, motion, traction in region.integrate(vertices, move[vertices]):
            rows = slice(row, row + len(motion))
            matrix[rows, :moved], matrix[rows, moved:], load[rows] = motion, -traction[:, :pulled], traction[:, pulled:]
            row = rows.stop
    solution = lu_solve(lu_factor(matrix, overwrite_a=True), load)
    result = np.zeros((len(move), 3, loads))
    result[move >= 0] = solution[:moved].reshape(-1, 3, loads)[move[move >= 0]]
    tractions = np.vstack([solution[moved:], np.eye(loads)])
    for region in regions:
        boundary = np.unique(region.triangles)
        inner = np.intersect1d(nodes, np.setdiff1d(region.members, boundary))
        nearest = boundary[KDTree(region.nodes[boundary]).query(region.nodes[inner])[1]]
        for some, motion, traction in region.integrate(inner, move[nearest]):
            result[some] = (traction @ tractions - motion @ solution[:moved]).reshape(-1, 3, loads)
    return result[nodes].reshape(len(nodes), 3, -1, 3).transpose(2, 3, 0, 1)


def _build_regions(body: LinearBody) -> tuple[list[_Region], np.ndarray, np.ndarray]:
    """Return the regions and, for each vertex, the numbers (N,) of its unknown displacement and traction, or -1."""
    mesh, parts = body.anatomy.mesh, _find_tissues(body)
    boundaries = [find_boundary_faces(mesh.tets[some]) for some, _ in parts]
    triangles, region = np.vstack(boundaries), np.repeat(np.arange(len(parts)), [len(each) for each in boundaries])
    inner = ~_is_in_table(triangles, mesh.surface)
    covered = body.fixed[triangles].all(axis=1) & ~inner
    _check_supports(body, triangles[covered], np.unique(triangles[inner]))
    # Refine the free surface, triangles with a vertex on it, and, if these include it, the interface.
    marked = np.any(np.isin(triangles, triangles[~covered & ~inner]), axis=1)
    marked = marked | (inner & np.any(marked[inner]))
    walls, whole = triangles[covered][:, TRIANGLE_EDGES].reshape(-1, 2), triangles
    nodes, triangles, parent, edges = _divide_triangles(mesh.nodes, whole, marked)
    region, inner, covered = region[parent], inner[parent], covered[parent]
    fixed, count = np.append(body.fixed, _is_in_table(edges, walls)), len(nodes)
    move = _index_vertices(np.setdiff1d(triangles, np.flatnonzero(fixed)), count)
    pull = _index_vertices(np.unique(triangles[covered | inner]), count)
    act, density = _index_vertices(np.asarray(body.loaded), count), np.zeros(count)
    # All triangles at `acting` are refined. `halved`: ends of the edge that a node halves; for a vertex, itself twice.
    density[body.loaded] = 0.25 / compute_vertex_areas(nodes, triangles[~inner])[body.loaded]
    halved, regions = np.vstack([np.arange(len(mesh.nodes)).repeat(2).reshape(-1, 2), edges]), []
    for number, (some, lame) in enumerate(parts):
        own = region == number
        ends, within, unknown = triangles[own].ravel(), np.repeat(inner[own], 3), np.repeat((inner | covered)[own], 3)
        sign = np.where(within & (number == 0), -1.0, 1.0)
        reaction = _build_sparse_matrix(np.where(unknown, pull[ends], -1), sign, pull.max() + 1)
        load = sum(
            _build_sparse_matrix(
                np.where(within, -1, act[corner]),
                (4.0 * (halved[ends] == corner[:, None]).mean(axis=1) - 1.0) * density[corner],
                len(body.loaded),
            )
            for corner in whole[parent[own]].T.repeat(3, axis=1)
        )
        displaced = _build_sparse_matrix(move[ends], np.ones(len(ends)), move.max() + 1)
        members, loaded = np.unique(mesh.tets[some]), sp.csr_array(sp.vstack([reaction, load]))
        regions.append(_Region(nodes, members, triangles[own], lame, displaced, loaded))
    return regions, move, pull


def _divide_triangles(nodes: np.ndarray, triangles: np.ndarray, is_divided: np.ndarray) -> tuple[np.ndarray, ...]:
    """Divide the triangles (S, 3) that are marked in `is_divided` (S,) into four.

    Return the nodes (N, 3) [m], given nodes first; the triangles; the original triangle of each; and the edges (E, 2)
    whose midpoints are the new nodes. New nodes may lie on edges of undivided triangles, since these triangles are
    fixed, and tractions may be discontinuous.
    """
    edges = triangles[is_divided][:, TRIANGLE_EDGES].reshape(-1, 2)
    _, first, place = np.unique(compute_row_keys(edges), return_index=True, return_inverse=True)
    (a, b, c), (ab, bc, ca) = triangles[is_divided].T, len(nodes) + place.reshape(-1, 3).T
    parts = np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1).reshape(-1, 3)
    parent = np.append(np.flatnonzero(~is_divided), np.repeat(np.flatnonzero(is_divided), 4))
    edges = edges[first]
    return np.vstack([nodes, nodes[edges].mean(axis=1)]), np.vstack([triangles[~is_divided], parts]), parent, edges


def _index_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return, for each of `count` vertices, its index in `vertices`, or -1 if it is not there."""
    numbers = np.full(count, -1)
    numbers[vertices] = np.arange(len(vertices))
    return numbers


def _build_sparse_matrix(row: np.ndarray, entries: np.ndarray, count: int) -> sp.csr_array:
    """Return the sparse matrix (count, n) with `entries` (n,) in `row` (n,) of each column; -1 makes a column empty."""
    some = np.flatnonzero(row >= 0)
    return sp.csr_array((entries[some], (row[some], some)), shape=(count, len(row)))


def _is_in_table(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of rows (n, k) of vertex numbers that occur in `table` (m, k), in any order of numbers."""
    keys = compute_row_keys(np.vstack([rows, table]))
    return np.isin(keys[: len(rows)], keys[len(rows) :])


def _find_tissues(body: LinearBody) -> list[tuple[np.ndarray, tuple[float, float]]]:
    """Return a mask (T,) and (mu, lambda) [Pa] of the brain and, if its tissue differs, of the tumour."""
    mesh, tissues = body.anatomy.mesh, []
    for some in (~body.anatomy.in_tumour, body.anatomy.in_tumour):
        labels = np.unique(mesh.region[some]).tolist()
        if len({tuple(body.lame[label]) for label in labels}) > 1:
            raise InputError(
                f"{' and '.join(map(describe_region, labels))} have different tissues: boundary elements need one for "
                "the tumour with its necrosis and one for all other regions."
            )
        tissues += [(some, tuple(body.lame[label])) for label in labels[:1]]
    return tissues if len({lame for _, lame in tissues}) > 1 else [(np.ones_like(tissues[0][0]), tissues[0][1])]


def _check_supports(body: LinearBody, fixed_triangles: np.ndarray, interface: np.ndarray) -> None:
    """Reject fixed vertices or forces that boundary elements cannot represent."""
    surface = np.isin(np.arange(len(body.fixed)), body.anatomy.mesh.surface)
    inner = surface < ~body.anatomy.orphaned
    inner[interface] = True
    bad, acting = np.flatnonzero(body.fixed & inner), check_vertex_numbers("acting", body.loaded, len(body.fixed))
    if len(bad):
        raise InputError(
            f"vertex {bad[0]} (and {len(bad) - 1} more) is fixed inside the body or at the tumour's surface: boundary "
            "elements need vertices that are fixed on the brain's outer surface only."
        )
    if not len(fixed_triangles):
        raise InputError("no surface triangle has three fixed vertices: fix a part of the surface.")
    if len(np.unique(acting)) < len(acting) or (body.fixed | ~surface)[acting].any():
        raise InputError("acting has vertices twice, fixed or inside: forces act on distinct vertices of free surface.")

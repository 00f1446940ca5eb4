"""L2 projection of the field of a mesh onto a grid, where sampling at the grid nodes is not accurate enough."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from ..geometry.tetmesh import find_boundary_faces
from .grid import Grid

# Points per block, to limit memory.
BLOCK_POINTS = 200_000


@dataclass(frozen=True)
class ProjectionSettings:
    """Settings of `project_field`."""

    fit_tolerance: float = 2e-5  # Interpolation error above which tetrahedra are fitted [m].
    test_density: float = 1.0  # points per grid spacing along a tetrahedron's longest edge, in the error test
    fit_density: float = 1.5  # the same in the fit
    max_subdivisions: int = 10  # maximum subdivisions of an edge
    surface_density: float = 2.0  # points per grid spacing along a surface triangle's longest edge
    surface_weight: float = 10.0  # weight of a cell face of surface, relative to a cell's volume
    # Penalty weights relative to the squared error.
    change_weight: float = 1e-3  # change of the field
    difference_weight: float = 1e-2  # differences of the change between nodes
    curvature_weight: float = 3e-3  # second differences of the field in the collar
    solver_tolerance: float = 1e-3  # relative tolerance of the linear solver
    max_iterations: int = 300  # maximum iterations of the linear solver


PROJECTION = ProjectionSettings()


@dataclass(frozen=True, eq=False)
class NodalField:
    """Field of values (V, 3) [m] at vertices `nodes` (V, 3) [m], linear in each tetrahedron of `tets` (T, 4)."""

    nodes: np.ndarray
    tets: np.ndarray
    values: np.ndarray


class _Samples(NamedTuple):
    """Sample points (n, 3) [m], with values (n, 3), weights (n,), and their tetrahedra or triangles (n,)."""

    points: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    simplex: np.ndarray


def project_field(grid: Grid, field: np.ndarray, inside: np.ndarray, collar: np.ndarray, body: NodalField) -> None:
    """Fit a grid field (3, I, J, K), sampled at nodes in a mesh (`inside`) and its `collar`, to the mesh field `body`.

    Nodes near interpolation errors above 0.02 mm are changed in place; collar nodes only if their value is not zero.
    The squared error is minimised over sample points in the tetrahedra and on their surface (L2 projection). Nodes
    outside the mesh represent the kink of the field at the surface. Penalties with small weights keep changes small and
    uniform, and the field linear in the collar.
    """
    flat, bad = field.reshape(3, -1), np.zeros(len(body.tets), bool)
    for some in _sample_tetrahedra(grid, body, np.arange(len(body.tets)), PROJECTION.test_density):
        numbers, weights = grid.find_corners(some.points)
        error = np.linalg.norm(_interpolate_flat_field(flat, numbers, weights) - some.values, axis=1)
        bad[some.simplex[error > PROJECTION.fit_tolerance]] = True
    free = np.zeros(flat.shape[1], bool)
    for some in _sample_tetrahedra(grid, body, np.flatnonzero(bad), PROJECTION.fit_density):
        free[grid.find_corners(some.points)[0]] = True
    free &= inside.reshape(-1) | (collar.reshape(-1) & flat.any(axis=0))
    nodes = np.flatnonzero(free)
    if not len(nodes):
        return
    column = np.full(len(free), -1)
    column[nodes] = np.arange(len(nodes))
    touched = np.isin(np.arange(len(body.nodes)), body.tets[bad])
    matrix, side = _build_penalties(grid, flat, nodes, column, inside.reshape(-1), collar.reshape(-1))
    within = _sample_tetrahedra(grid, body, np.flatnonzero(touched[body.tets].any(axis=1)), PROJECTION.fit_density)
    for some in chain(within, _sample_surface(grid, body, touched)):
        numbers, weights = grid.find_corners(some.points)
        rows = _build_rows(column, numbers, weights)
        weighted = rows.T.multiply(some.weights).tocsr()
        matrix = matrix + weighted @ rows
        side += weighted @ (some.values - _interpolate_flat_field(flat, numbers, weights))
    scale, change = sparse.diags(1.0 / np.asarray(matrix.diagonal(), np.float64)), np.zeros_like(field)
    for part, right in zip(change.reshape(3, -1), side.T, strict=True):
        part[nodes] = cg(matrix, right, rtol=PROJECTION.solver_tolerance, maxiter=PROJECTION.max_iterations, M=scale)[0]
    field += change


def _interpolate_flat_field(field: np.ndarray, node_numbers: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return values (n, 3) of a flattened `field` (3, N), by node numbers (n, m) and weights (n, m)."""
    return np.stack([np.einsum("nc,nc->n", part[node_numbers], weights) for part in field], axis=-1)


def _sample_tetrahedra(grid: Grid, body: NodalField, tet_numbers: np.ndarray, density: float) -> Iterator[_Samples]:
    """Yield samples of the tetrahedra, `density` per grid spacing along the longest edge, weighted by volume."""
    corners = body.nodes[body.tets[tet_numbers]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (6.0 * grid.spacing**3)
    for some in _sample_simplices(grid, body, body.tets[tet_numbers], volumes, density):
        yield some._replace(simplex=tet_numbers[some.simplex])


def _sample_surface(grid: Grid, body: NodalField, vertex_mask: np.ndarray) -> Iterator[_Samples]:
    """Yield samples of the surface triangles that have a vertex in `vertex_mask` (V,)."""
    faces = find_boundary_faces(body.tets)
    faces = faces[vertex_mask[faces].any(axis=1)]
    a, b, c = body.nodes[faces].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / (2.0 * grid.spacing**2)
    return _sample_simplices(grid, body, faces, PROJECTION.surface_weight * areas, PROJECTION.surface_density)


def _sample_simplices(
    grid: Grid, body: NodalField, simplices: np.ndarray, weights: np.ndarray, density: float
) -> Iterator[_Samples]:
    """Yield regular lattice points of `simplices` (n, c); the weight (n,) of a simplex is divided among its points."""
    corners, size = body.nodes[simplices], simplices.shape[1]
    first, second = np.triu_indices(size, 1)
    longest = np.linalg.norm(corners[:, first] - corners[:, second], axis=2).max(axis=1, initial=0.0)
    orders = np.clip(np.ceil(density * longest / grid.spacing), 1, PROJECTION.max_subdivisions).astype(int)
    for order in np.unique(orders):
        lattice, alike = _build_lattice(order, size), np.flatnonzero(orders == order)
        step = max(1, BLOCK_POINTS // len(lattice))
        for begin in range(0, len(alike), step):
            some = alike[begin : begin + step]
            yield _Samples(
                (lattice @ corners[some]).reshape(-1, 3),
                (lattice @ body.values[simplices[some]]).reshape(-1, 3),
                np.repeat(weights[some] / len(lattice), len(lattice)),
                np.repeat(some, len(lattice)),
            )


@cache
def _build_lattice(order: int, size: int) -> np.ndarray:
    """Return barycentric weights (n, size) of a regular lattice that divides simplex edges into `order` parts."""
    parts = np.indices((order + 1,) * (size - 1)).reshape(size - 1, -1)
    weights = np.stack([*parts, order - parts.sum(axis=0)], axis=1)
    return weights[weights[:, -1] >= 0] / order


def _build_rows(column: np.ndarray, node_numbers: np.ndarray, weights: np.ndarray) -> sparse.csr_matrix:
    """Return the sparse matrix (n, free) of sums over free nodes, with node numbers (n, m) and weights (n, m)."""
    columns = column[node_numbers]
    free = columns >= 0
    row = np.repeat(np.arange(len(node_numbers)), free.sum(axis=1))
    shape = len(node_numbers), int(column.max()) + 1
    return sparse.csr_matrix((np.broadcast_to(weights, columns.shape)[free], (row, columns[free])), shape)


def _build_penalties(
    grid: Grid, flat: np.ndarray, nodes: np.ndarray, column: np.ndarray, inside: np.ndarray, collar: np.ndarray
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Return the matrix and right-hand side (n, 3) of penalties on size, unevenness and curvature of the changes."""
    pairs, bends = [], []
    for index, side, stride in zip(
        np.unravel_index(nodes, grid.shape), grid.shape, (grid.shape[1] * grid.shape[2], grid.shape[2], 1), strict=True
    ):
        pairs.append((nodes[:, None] + [0, stride])[index + 1 < side])
        starts = [(nodes + stride * at)[(index + at >= 0) & (index + at + 2 < side)] for at in (-2, -1, 0)]
        bends.append(np.unique(np.concatenate(starts))[:, None] + stride * np.arange(3))
    pair, bend = np.concatenate(pairs), np.concatenate(bends)
    pair = pair[(column[pair] >= 0).all(axis=1)]
    bend = bend[(inside | collar)[bend].all(axis=1) & collar[bend].any(axis=1)]
    second = np.array([1.0, -2.0, 1.0])
    even, straight = _build_rows(column, pair, np.array([1.0, -1.0])), _build_rows(column, bend, second)
    matrix = (
        PROJECTION.change_weight * sparse.identity(len(nodes))
        + PROJECTION.difference_weight * even.T @ even
        + PROJECTION.curvature_weight * straight.T @ straight
    )
    return matrix.tocsr(), -PROJECTION.curvature_weight * straight.T @ (flat[:, bend] @ second).T

"""Values of a grid between which a body's field is read with the least error, where sampling it is not exact enough."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from ..geometry.tetmesh import find_single_faces
from .grid import Grid

# Tetrahedra in which the sampled field is off by more [m] are fitted.
ENOUGH = 2e-5
# Points along a tetrahedron's longest edge for each node of the grid, to find those and to fit them; and the most.
LOOKED, FITTED, MOST = 1.0, 1.5, 10
# The same along a triangle's edge; the square of the error on a cell's face of surface counts as in so many cells.
ON_SURFACE, SURFACE = 2.0, 10.0
# Points that are looked at together: bounds the memory that it takes.
TOGETHER = 200_000
# Against the square of the error: of a change, of a change from node to node, of a bend outside the body.
SMALL, EVEN, STRAIGHT = 1e-3, 1e-2, 3e-3
# The equations are solved so exactly, in so many steps at most.
EXACT, STEPS = 1e-3, 300


@dataclass(frozen=True, eq=False)
class NodalField:
    """A field (V, 3) [m] of vertices `nodes` (V, 3) [m], linear in each of the tetrahedra (T, 4)."""

    nodes: np.ndarray
    tets: np.ndarray
    values: np.ndarray


class _Samples(NamedTuple):
    """Points (n, 3) [m]: their values (n, 3), their weights (n,), and their tetrahedra or triangles (n,)."""

    points: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    simplex: np.ndarray


def project(grid: Grid, field: np.ndarray, inside: np.ndarray, collar: np.ndarray, body: NodalField) -> None:
    """Change a field (3, I, J, K), sampled inside a body and in a collar (I, J, K) round it, to fit it between nodes.

    It is done in place, where sampling is off by more than 0.02 mm, and in the collar where it moves. The square of the
    error is least over points of the tetrahedra and of their surface (a projection in L2). There the field has a kink,
    and what lies outside is free to bear it. A small weight keeps changes small and even, and the field straight in
    the collar.
    """
    flat = field.reshape(3, -1)
    bad = np.zeros(len(body.tets), bool)
    for some in _samples(grid, body, np.arange(len(body.tets)), LOOKED):
        numbers, weights = grid.corners(some.points)
        bad[some.simplex[np.linalg.norm(_read(flat, numbers, weights) - some.values, axis=1) > ENOUGH]] = True
    free = np.zeros(flat.shape[1], bool)
    for some in _samples(grid, body, np.flatnonzero(bad), FITTED):
        free[grid.corners(some.points)[0]] = True
    free &= inside.reshape(-1) | (collar.reshape(-1) & flat.any(axis=0))
    nodes = np.flatnonzero(free)
    if not len(nodes):
        return
    column = np.full(len(free), -1)
    column[nodes] = np.arange(len(nodes))
    touched = np.zeros(len(body.nodes), bool)
    touched[body.tets[bad]] = True
    matrix, side = _penalties(grid, flat, nodes, column, inside.reshape(-1), collar.reshape(-1))
    within = _samples(grid, body, np.flatnonzero(touched[body.tets].any(axis=1)), FITTED)
    for some in chain(within, _on_surface(grid, body, touched)):
        numbers, weights = grid.corners(some.points)
        rows = _rows(column, numbers, weights)
        weighted = rows.T.multiply(some.weights).tocsr()
        matrix = matrix + weighted @ rows
        side += weighted @ (some.values - _read(flat, numbers, weights))
    scale = sparse.diags(1.0 / np.asarray(matrix.diagonal(), np.float64))
    change = np.zeros_like(field)
    for part, right in zip(change.reshape(3, -1), side.T, strict=True):
        part[nodes] = cg(matrix, right, rtol=EXACT, maxiter=STEPS, M=scale)[0]
    field += change


def _read(flat: np.ndarray, numbers: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return a flat field (3, N) between nodes: (n, 3)."""
    return np.stack([np.einsum("nc,nc->n", part[numbers], weights) for part in flat], axis=-1)


def _samples(grid: Grid, body: NodalField, which: np.ndarray, density: float) -> Iterator[_Samples]:
    """Points in some tetrahedra, so many to a node's distance along the longest edge; by their share of a cell."""
    corners = body.nodes[body.tets[which]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (6.0 * grid.spacing**3)
    for some in _lattices(grid, body, body.tets[which], volumes, density):
        yield some._replace(simplex=which[some.simplex])


def _on_surface(grid: Grid, body: NodalField, touched: np.ndarray) -> Iterator[_Samples]:
    """Points of the surface's triangles of which a vertex is touched (V,)."""
    faces = find_single_faces(body.tets)
    faces = faces[touched[faces].any(axis=1)]
    a, b, c = body.nodes[faces].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / (2.0 * grid.spacing**2)
    return _lattices(grid, body, faces, SURFACE * areas, ON_SURFACE)


def _lattices(
    grid: Grid, body: NodalField, simplices: np.ndarray, weights: np.ndarray, density: float
) -> Iterator[_Samples]:
    """Points of simplices (n, c) of vertices, each of a lattice, evenly; they share the weights (n,)."""
    corners = body.nodes[simplices]
    size = simplices.shape[1]
    first, second = np.triu_indices(size, 1)
    longest = np.linalg.norm(corners[:, first] - corners[:, second], axis=2).max(axis=1, initial=0.0)
    orders = np.clip(np.ceil(density * longest / grid.spacing), 1, MOST).astype(int)
    for order in np.unique(orders):
        lattice, alike = _lattice(order, size), np.flatnonzero(orders == order)
        step = max(1, TOGETHER // len(lattice))
        for begin in range(0, len(alike), step):
            some = alike[begin : begin + step]
            yield _Samples(
                (lattice @ corners[some]).reshape(-1, 3),
                (lattice @ body.values[simplices[some]]).reshape(-1, 3),
                np.repeat(weights[some] / len(lattice), len(lattice)),
                np.repeat(some, len(lattice)),
            )


@cache
def _lattice(order: int, size: int) -> np.ndarray:
    """Weights (n, size) of a simplex's corners at the points that cut its edges into so many parts."""
    parts = np.indices((order + 1,) * (size - 1)).reshape(size - 1, -1)
    weights = np.stack([*parts, order - parts.sum(axis=0)], axis=1)
    return weights[weights[:, -1] >= 0] / order


def _rows(column: np.ndarray, numbers: np.ndarray, weights: np.ndarray) -> sparse.csr_matrix:
    """Return sums (n, free) of nodes (n, m) by weights (n, m), those that are free."""
    columns = column[numbers]
    free = columns >= 0
    row = np.repeat(np.arange(len(numbers)), free.sum(axis=1))
    shape = len(numbers), int(column.max()) + 1
    return sparse.csr_matrix((np.broadcast_to(weights, columns.shape)[free], (row, columns[free])), shape)


def _penalties(
    grid: Grid, flat: np.ndarray, nodes: np.ndarray, column: np.ndarray, inside: np.ndarray, collar: np.ndarray
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """What keeps changes small and even, and the field straight where it leaves the body: matrix, right side (n, 3)."""
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
    even, straight = _rows(column, pair, np.array([1.0, -1.0])), _rows(column, bend, np.array([1.0, -2.0, 1.0]))
    matrix = SMALL * sparse.identity(len(nodes)) + EVEN * even.T @ even + STRAIGHT * straight.T @ straight
    return matrix.tocsr(), -STRAIGHT * straight.T @ (flat[:, bend] @ np.array([1.0, -2.0, 1.0])).T

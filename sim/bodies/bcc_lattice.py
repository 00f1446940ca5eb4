"""Graded body-centred cubic lattice of tetrahedra, the background mesh of `isosurface_stuffing`.

A 2:1 balanced octree is filled with tetrahedra as in Labelle & Shewchuk 2007, "Isosurface Stuffing: Fast Tetrahedral
Meshes with Good Dihedral Angles", section 3. Between cells of equal size are BCC tetrahedra (dihedral angles 60 and 90
degrees). Between cells of different size are pyramids, split along the diagonal through the centre of the larger face
(dihedral angles of at least 45 degrees).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

NEIGHBOURS = np.ones((3, 3, 3), bool)  # all 26 neighbours of a cell, for the 2:1 balance
# Corners of a square face in the two tangential axes, in cyclic order; edge k joins corners k and k + 1.
FACE_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])

Sizing = Callable[[np.ndarray], np.ndarray]
"""Function that returns the requested cell size (n,) [m] at points (n, 3) [m]."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Lattice of tetrahedra that fills a box.

    `nodes` (V, 3) [m]; `tets` (T, 4), positively oriented; `is_centre` (V,) bool: True at a cell centre, False at a
    cell corner. Edges between a centre and a corner are short; all other edges are long.
    """

    nodes: np.ndarray
    tets: np.ndarray
    is_centre: np.ndarray


def build_graded_lattice(low: np.ndarray, high: np.ndarray, max_edge: float, max_level: int, sizing: Sizing) -> Lattice:
    """Return the lattice over the box from `low` (3,) to `high` (3,) [m].

    Cells of edge `max_edge` [m] are halved up to `max_level` times, until their edge does not exceed `sizing`. Adjacent
    cells, including diagonal neighbours, differ by at most one halving.
    """
    count = np.ceil((high - low) / max_edge).astype(int)
    origin = 0.5 * (low + high) - 0.5 * max_edge * count
    exists, split = _build_octree(origin, count, max_edge, max_level, sizing)
    unit = max_edge / 2 ** (max_level + 1)  # half the finest cell: every node has whole coordinates
    span = count * 2 ** (max_level + 1) + 1

    leaves = [there & ~halved for there, halved in zip(exists, split, strict=True)]
    corners = [np.argwhere(leaf) * 2 ** (max_level + 1 - level) for level, leaf in enumerate(leaves)]
    known = np.unique(
        np.concatenate(
            [
                _compute_keys(
                    (at[:, None] + 2 ** (max_level + 1 - level) * np.indices((2, 2, 2)).reshape(3, 8).T), span
                ).ravel()
                for level, at in enumerate(corners)
            ]
        )
    )
    cells: list[np.ndarray] = []
    for level in range(max_level + 1):
        edge = 2 ** (max_level + 1 - level)
        for axis in range(3):
            cells += _build_tets_at_equal_cells(leaves[level], axis, edge, known, span)
            cells += _build_tets_at_unequal_cells(leaves[level], exists[level], axis, edge)
    corners_of_tets = np.concatenate(cells)
    keys, tets = np.unique(_compute_keys(corners_of_tets, span), return_inverse=True)
    whole = np.stack(np.unravel_index(keys, span), axis=1)
    return Lattice(origin + unit * whole, tets, ~np.isin(keys, known))


def _build_octree(
    origin: np.ndarray, count: np.ndarray, coarsest: float, levels: int, size: Sizing
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return two boolean grids for each octree level: mask of the existing cells, and mask of the halved cells."""
    split, there = [], np.ones(count, bool)
    for level in range(levels):
        edge, index = coarsest / 2**level, np.argwhere(there)
        halved = np.zeros(there.shape, bool)
        halved[tuple(index.T)] = size(origin + edge * (index + 0.5)) < edge
        split.append(halved)
        there = _mark_children(halved)
    split.append(np.zeros(count * 2**levels, bool))
    for level in range(levels - 1, 0, -1):  # balance: a halved cell's neighbours exist, so their parents are halved
        grown = ndimage.binary_dilation(split[level], NEIGHBOURS)
        split[level - 1] |= grown.reshape(*np.stack([count * 2 ** (level - 1), [2, 2, 2]], 1).ravel()).any((1, 3, 5))
    return [np.ones(count, bool), *[_mark_children(halved) for halved in split[:-1]]], split


def _mark_children(is_halved: np.ndarray) -> np.ndarray:
    return is_halved.repeat(2, 0).repeat(2, 1).repeat(2, 2)


def _compute_keys(coordinates: np.ndarray, grid_shape: np.ndarray) -> np.ndarray:
    """Return a unique integer for each integer coordinate triple (..., 3)."""
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(coordinates, -1, 0)), tuple(grid_shape)))


def _compute_face_corners(corner: np.ndarray, axis: int, edge: int, is_upper: bool) -> np.ndarray:
    """Return corners (n, 4, 3), in cyclic order, of the lower or upper face across `axis` of the cells at `corner`."""
    offset = np.zeros((4, 3), int)
    offset[:, [(axis + 1) % 3, (axis + 2) % 3]] = FACE_CORNERS * edge
    offset[:, axis] = edge * is_upper
    return corner[:, None] + offset


def _build_tets_at_equal_cells(
    is_leaf: np.ndarray, axis: int, edge: int, node_keys: np.ndarray, grid_shape: np.ndarray
) -> list[np.ndarray]:
    """Return the BCC tetrahedra around each face between two leaves of equal size, halved at edges with a midpoint."""
    ahead = np.delete(is_leaf, 0, axis)
    corner = np.argwhere(np.delete(is_leaf, -1, axis) & ahead) * edge
    below = corner + edge // 2
    above = below + edge * np.eye(3, dtype=int)[axis]
    square, tets = _compute_face_corners(corner, axis, edge, is_upper=True), []
    for k in range(4):
        start, end = square[:, k], square[:, (k + 1) % 4]
        middle = (start + end) // 2
        halved = np.isin(_compute_keys(middle, grid_shape), node_keys)
        tets.append(np.stack([below, above, start, end], 1)[~halved])
        tets.append(np.stack([below, above, start, middle], 1)[halved])
        tets.append(np.stack([below, above, middle, end], 1)[halved])
    return tets


def _build_tets_at_unequal_cells(is_leaf: np.ndarray, is_cell: np.ndarray, axis: int, edge: int) -> list[np.ndarray]:
    """Return the split pyramids on both sides of each face between a leaf and a leaf of twice its size."""
    tets = []
    for step in (-1, 1):
        neighbour, rim = np.roll(is_cell, -step, axis), [slice(None)] * 3
        rim[axis] = slice(-1, None) if step > 0 else slice(0, 1)
        neighbour[tuple(rim)] = True  # no cell exists beyond the box
        index = np.argwhere(is_leaf & ~neighbour)
        small = index * edge + edge // 2
        large = (index + step * np.eye(3, dtype=int)[axis]) // 2 * 2 * edge + edge
        square = _compute_face_corners(index * edge, axis, edge, is_upper=step > 0)
        # The larger face's centre is the corner at which both tangential indices change from even to odd.
        tangential = np.stack([index[:, (axis + 1) % 3], index[:, (axis + 2) % 3]], 1)
        first = np.argmax((FACE_CORNERS[None] == 1 - tangential[:, None] % 2).all(2), axis=1)
        a, b, c, d = (square[np.arange(len(square)), (first + k) % 4] for k in range(4))
        lower, upper = (small, large) if step > 0 else (large, small)
        for p, q, r in ((a, b, c), (a, c, d)):
            tets += [np.stack([p, q, r, upper], 1), np.stack([p, r, q, lower], 1)]
    return tets

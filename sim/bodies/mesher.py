"""From two solids to one conforming mesh of brain and tumour with about as many nodes as asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from ..anatomy import BRAIN_LABEL, TUMOUR_LABEL
from ..errors import InputError
from ..geometry.tetmesh import TetMesh, faces_once
from .bcc_lattice import graded_lattice
from .isosurface_stuffing import Pieces, cut, whole
from .manifold_repair import clean, ears
from .mesh_smoothing import GOOD_SINE, Projection, fitted, improved, smallest_sines
from .signed_distance import Field, onto_level

TOLERANCE = 0.03  # of the number of nodes asked for, at which the search for the lattice's size stops
TRIALS = 8
FINE = 0.5  # of the coarsest cell: the cells at the tumour and the craniotomy
CELLS_PER_RADIUS = 2.5  # at least, across the tumour's radius
GROWTH = 0.5  # of a cell's size per distance from the points of interest
ROUNDING = 2.0**0.5  # a cell up to this much larger than wanted is not halved
SLACKS = (0.0, 3e-4, 6e-4, 1.2e-3, 2.4e-3)  # [m] that nodes may leave their surface by, attempt by attempt
DEEPEST = 4  # halvings of the coarsest cell
TOO_COARSE = "so few nodes do not show the brain or the tumour: ask for more nodes, or check the labels."
MORE = (1.25, 1.6, 2.0, 2.5)  # times the nodes asked for, tried only to say how many would do


@dataclass(frozen=True, eq=False)
class Solids:
    """What is to be meshed.

    Parameters
    ----------
    brain, tumour
        Fields of the whole solid (brain and tumour together) and of the tumour.
    low, high
        (3,) [m]: a box round the solid.
    tumour_volume
        [m^3], held exactly as far as the nodes allow.
    interface, opening
        Points (n, 3) [m] on the tumour's surface and on the cortex to be opened: there the mesh is fine.
    """

    brain: Field
    tumour: Field
    low: np.ndarray
    high: np.ndarray
    tumour_volume: float
    interface: np.ndarray
    opening: np.ndarray


def mesh_solids(solids: Solids, count: int) -> TetMesh:
    """The mesh of `solids` with `count` nodes, to within 10 % and mostly 3 %.

    Raises
    ------
    InputError
        A solid that so few nodes cannot show, with a number that can, if one of up to 2.5 times as many does; a count
        that the search for a lattice size does not reach.
    """
    mesh = _meshed(solids, count)
    if mesh is not None:
        return mesh
    more = (int(round(count * times, -2)) for times in MORE)
    would_do = next((number for number in more if _would_do(solids, number)), None)
    remedy = "smooth the labels" if would_do is None else f"ask for {would_do}, or smooth the labels"
    raise InputError(f"the surfaces are too intricate for {count} nodes: {remedy}.")


def _would_do(solids: Solids, count: int) -> bool:
    try:
        return _meshed(solids, count) is not None
    except InputError:
        return False


def _meshed(solids: Solids, count: int) -> TetMesh | None:
    """The mesh with `count` nodes; None where some of its tetrahedra are inside out. Raises as `mesh_solids`."""
    volume = float(np.prod(solids.high - solids.low))
    edge, best = (volume / count) ** (1.0 / 3.0), None
    for _ in range(TRIALS):
        pieces = carve(solids, edge)
        reached = len(pieces.nodes)
        if best is None or abs(reached - count) < abs(len(best.nodes) - count):
            best = pieces
        if abs(reached - count) <= TOLERANCE * count:
            break
        edge *= float(np.clip((reached / count) ** 0.4, 0.5, 2.0))
    assert best is not None
    if abs(len(best.nodes) - count) > 0.1 * count:
        raise InputError(f"{count} nodes cannot be had for this anatomy ({len(best.nodes)} is next): ask for more.")
    return _finished(solids, best)


def carve(solids: Solids, edge: float) -> Pieces:
    """The solid on a lattice of coarsest cell `edge` [m], split along the tumour's surface."""
    radius = (0.75 / np.pi * solids.tumour_volume) ** (1.0 / 3.0)
    wanted = (
        (KDTree(solids.interface), min(FINE * edge, radius / CELLS_PER_RADIUS)),
        (KDTree(solids.opening), FINE * edge),
    )
    levels = min(int(np.rint(np.log2(edge / wanted[0][1]))), DEEPEST)

    def size(points: np.ndarray) -> np.ndarray:
        return ROUNDING * np.min([fine + GROWTH * tree.query(points)[0] for tree, fine in wanted], axis=0)

    lattice = graded_lattice(solids.low - edge, solids.high + edge, edge, levels, size)
    body = cut(whole(lattice), solids.brain)
    if not body.inside.any():
        raise InputError(TOO_COARSE)
    body = body.kept(body.inside)
    body = body.kept(clean(body.tets))
    surface = np.zeros(len(body.nodes), bool)
    surface[faces_once(body.tets)] = True
    return cut(body, solids.tumour, pinned=surface)


def _finished(solids: Solids, pieces: Pieces) -> TetMesh | None:
    """The surfaces fitted, what is flat on them trimmed, the bad angles improved; None: some remain inside out."""
    if not pieces.inside.any():
        raise InputError(TOO_COARSE)
    surface, _ = _surfaces(pieces)
    nodes = fitted(pieces.nodes, faces_once(pieces.tets), solids.brain, surface)
    nodes = fitted(nodes, faces_once(pieces.tets[pieces.inside]), solids.tumour, ~surface, solids.tumour_volume)
    pieces = replace(pieces, nodes=nodes)
    for slack in SLACKS:
        bad = smallest_sines(pieces.nodes[pieces.tets]) < GOOD_SINE
        pieces = pieces.kept(~ears(pieces.tets, bad))
        pieces = replace(pieces, nodes=improved(pieces.nodes, pieces.tets, _projection(solids, pieces, slack)))
    if (smallest_sines(pieces.nodes[pieces.tets]) <= 0.0).any():
        return None
    region = np.where(pieces.inside, TUMOUR_LABEL, BRAIN_LABEL)
    return TetMesh(pieces.nodes, pieces.tets, region)


def _surfaces(pieces: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Which nodes (V,) lie on the outer surface, and which on the tumour's surface."""
    marks = np.zeros((2, len(pieces.nodes)), bool)
    marks[0, faces_once(pieces.tets)] = True
    marks[1, faces_once(pieces.tets[pieces.inside])] = True
    return marks[0], marks[1]


def _projection(solids: Solids, pieces: Pieces, slack: float) -> Projection:
    """Keeps each node within `slack` [m] of the levels of the fields on which it lies now."""
    surface, interface = _surfaces(pieces)
    interface[np.setdiff1d(pieces.tets[pieces.inside], pieces.tets[~pieces.inside])] = False  # cortex that is tumour
    levels = solids.brain(pieces.nodes), solids.tumour(pieces.nodes)

    def project(points: np.ndarray, of: np.ndarray) -> np.ndarray:
        placed = points.copy()
        for field, level, on in ((solids.tumour, levels[1], interface), (solids.brain, levels[0], surface)):
            rows = on[of]
            aim = level[of[rows]]
            placed[rows] = onto_level(field, placed[rows], np.clip(field(placed[rows]), aim - slack, aim + slack))
        return placed

    return project


def surface_errors(nodes: np.ndarray, triangles: np.ndarray, field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Distances (15 S,) [m] from points spread over triangles (S, 3) to a field's surface, and their shares of area."""
    spread = np.array([(i, j, 12 - i - j) for i in range(1, 12, 2) for j in range(1, 12 - i, 2)]) / 12.0
    corners = nodes[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    points = np.einsum("pk,tki->tpi", spread, corners).reshape(-1, 3)
    return np.abs(field(points)), np.repeat(area / area.sum() / len(spread), len(spread))

"""Red-green refinement of an anatomy's mesh, everywhere or near the exposed cortex."""

from itertools import combinations

import numpy as np
from scipy.spatial import KDTree

from ..anatomy import Anatomy
from ..discretisation.space import discretise
from ..errors import InputError
from ..geometry.surface import compute_edge_lengths
from ..geometry.tetmesh import QUADRATIC_EDGES, TetMesh, orient_tetrahedra

# Local nodes of a quadratic tetrahedron: four children with one corner each; the octahedron between them is cut along
# one of its three diagonals, around which its other four nodes lie in this order.
CORNERS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]])
DIAGONALS = np.array([[4, 9], [5, 7], [6, 8]])
DIAGONAL_RINGS = np.array([[6, 7, 8, 5], [4, 6, 9, 8], [4, 5, 9, 7]])
# Local node at the midpoint of each edge.
MIDPOINT_NODES = {frozenset(edge): 4 + k for k, edge in enumerate(QUADRATIC_EDGES.tolist())}


def _build_patterns() -> dict[tuple[int, ...], list[list[int]]]:
    """Return the child tetrahedra by halved edges: no edge, one edge, two opposite edges, or all edges of a face."""
    found: dict[tuple[int, ...], list[list[int]]] = {(): [[0, 1, 2, 3]]}
    for a, b in combinations(range(4), 2):
        c, d = (k for k in range(4) if k not in (a, b))
        one, other = MIDPOINT_NODES[frozenset((a, b))], MIDPOINT_NODES[frozenset((c, d))]
        found[(one,)] = [[a, one, c, d], [one, b, c, d]]
        found[tuple(sorted((one, other)))] = [[x, one, y, other] for x in (a, b) for y in (c, d)]
    for a, b, c in combinations(range(4), 3):
        ab, bc, ac = (MIDPOINT_NODES[frozenset(edge)] for edge in ((a, b), (b, c), (a, c)))
        d = 6 - a - b - c
        found[tuple(sorted((ab, bc, ac)))] = [[a, ab, ac, d], [ab, b, bc, d], [ac, bc, c, d], [ab, bc, ac, d]]
    return found


PATTERNS = _build_patterns()  # children by halved edges


def _find_closing_patterns() -> np.ndarray:
    """Return, for each of the 64 sets of halved edges, the smallest pattern (64, 6) bool that contains the set."""
    sets = (np.arange(64)[:, None] >> np.arange(6)) & 1 > 0
    known = np.array([np.isin(np.arange(4, 10), one) for one in sorted(PATTERNS, key=len)] + [np.ones(6, bool)])
    return known[(sets[:, None] <= known).all(axis=2).argmax(axis=1)]


CLOSING_PATTERNS = _find_closing_patterns()  # smallest pattern by the bit mask of halved edges


def refine(anatomy: Anatomy, near_opening: bool = False) -> Anatomy:
    """Return the anatomy with all edges halved or, if `near_opening`, only the edges near the exposed cortex.

    An edge is near if its midpoint is within a mean edge length of the exposed cortex. Original nodes keep their
    numbers. New nodes are fixed or slide by the rules for quadratic elements. A tetrahedron is split into eight or, at
    the border of the refined region, into two or four: Bey 1995, "Tetrahedral grid refinement", Computing 55:355-378.
    In contrast to the paper, the inner octahedron is split along its shortest diagonal.

    Raises
    ------
    InputError
        The mesh has mid-edge nodes.
    """
    mesh = anatomy.mesh
    if mesh.middles is not None:
        raise InputError("a quadratic mesh is not refined: give the linear one.")
    space = discretise(mesh, "p2")
    nodes, table, count = space.nodes, space.table, len(mesh.nodes)
    opening = space.surface[anatomy.craniotomy[mesh.surface].all(axis=1)]
    halved = np.ones(space.count, bool)
    if near_opening:
        reach = compute_edge_lengths(nodes[anatomy.open_surface]).mean()
        halved[count:] = KDTree(nodes[np.unique(opening)]).query(nodes[count:])[0] <= reach
    halved = _make_conforming(table, halved)
    tets, parent = _build_children(nodes, table, halved[table[:, 4:]])
    fixed, normal = space.extend_fixed(anatomy.fixed), space.extend_normals(anatomy.slide_normal, anatomy.fixed)
    craniotomy = np.zeros(space.count, bool)
    craniotomy[opening] = True
    craniotomy[:count] = anatomy.craniotomy
    free = ~fixed.any(axis=1) & (normal == 0.0).all(axis=1)
    tets, _ = orient_tetrahedra(nodes, tets)
    number = np.cumsum(halved) - 1
    fine = TetMesh(nodes[halved], number[tets], mesh.region[parent])
    return Anatomy(fine, fixed[halved], normal[halved], (craniotomy & free)[halved])


def _make_conforming(elements: np.ndarray, is_halved: np.ndarray) -> np.ndarray:
    """Return the mask `is_halved` (N,) of midpoints, extended until the halved edges of each element form a pattern."""
    is_halved, middles = is_halved.copy(), elements[:, 4:]
    while True:
        asked = is_halved[middles]
        cut = CLOSING_PATTERNS[asked @ (1 << np.arange(6))]
        if (cut == asked).all():
            return is_halved
        is_halved[middles[cut]] = True


def _build_children(nodes: np.ndarray, elements: np.ndarray, is_halved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return child tetrahedra (C, 4) and their parents (C,), sorted by parent; `is_halved` (T, 6) marks edges."""
    tets, parent = [], []
    for pattern, parts in PATTERNS.items():
        rows = np.flatnonzero((is_halved == np.isin(np.arange(4, 10), pattern)).all(axis=1))
        tets.append(elements[rows][:, parts].reshape(-1, 4))
        parent.append(np.repeat(rows, len(parts)))
    rows = np.flatnonzero(is_halved.all(axis=1))
    whole = elements[rows]
    ends = nodes[whole[:, DIAGONALS]]
    shortest = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2).argmin(axis=1)
    around = DIAGONAL_RINGS[shortest]
    inner = [np.column_stack([DIAGONALS[shortest], around[:, k], around[:, (k + 1) % 4]]) for k in range(4)]
    octahedron = np.stack([np.take_along_axis(whole, one, axis=1) for one in inner], axis=1)
    tets.append(np.concatenate([whole[:, CORNERS], octahedron], axis=1).reshape(-1, 4))
    parent.append(np.repeat(rows, 8))
    order = np.argsort(np.concatenate(parent), kind="stable")
    return np.concatenate(tets)[order], np.concatenate(parent)[order]

"""Isosurface stuffing: snap lattice nodes to a zero level set, then split the tetrahedra that still cross it.

Labelle & Shewchuk 2007, "Isosurface Stuffing: Fast Tetrahedral Meshes with Good Dihedral Angles". For two materials the
method is applied twice: at the outer surface, where only the inside is kept, and at the interface, where both sides
are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.tetmesh import EDGES
from .bcc_lattice import Lattice
from .signed_distance import Field

CENTRE, CORNER, CUT = 0, 1, 2  # node kinds: cell centre, cell corner, point on an earlier cut

# Even permutations of 0..3; row k puts corner k first.
LONE_FIRST = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
PAIR_FIRST = {3: [0, 1, 2, 3], 5: [0, 2, 3, 1], 9: [0, 3, 1, 2], 6: [1, 2, 0, 3], 10: [1, 3, 2, 0], 12: [2, 3, 0, 1]}
# Same for two corners first, by the bit mask of their numbers.
# Dompierre et al. 1999: rotate a prism so that its smallest node comes first, then split the two quadrilaterals there
# from that node and the third from its own smallest; neighbouring prisms then conform without communication.
PRISM_ROTATIONS = np.array(
    [
        [0, 1, 2, 3, 4, 5],
        [1, 2, 0, 4, 5, 3],
        [2, 0, 1, 5, 3, 4],
        [3, 5, 4, 0, 2, 1],
        [4, 3, 5, 1, 0, 2],
        [5, 4, 3, 2, 1, 0],
    ]
)
# Tetrahedra of a prism whose third quadrilateral is split along nodes 1-5, or along 2-4.
SPLIT_15 = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
SPLIT_24 = np.array([[0, 1, 2, 4], [0, 4, 2, 5], [0, 4, 5, 3]])


@dataclass(frozen=True)
class IsosurfaceStuffingOptions:
    """Options of `cut_mesh`: snapping thresholds, and accuracy of edge crossings.

    Parameters
    ----------
    long_edge_snap_fraction, short_edge_snap_fraction
        Fractions of a long and of a short lattice edge. If a crossing is nearer to a node than this fraction, the node
        moves to the surface. On an ungraded lattice every dihedral angle exceeds 10.7 degrees (section 4 of the paper).
    cut_edge_snap_fraction
        Same fraction for an edge that ends at a node of an earlier cut, for which the paper gives no value.
    max_snap_fraction
        Maximum snapping distance, as a fraction of the shortest edge at the node. Where the cell size changes, the
        fraction of a long edge could otherwise invert the small tetrahedra at the node.
    max_bisections
        Bisection steps per edge: 24 steps leave an error of 6e-8 of the edge length.
    """

    long_edge_snap_fraction: float = 0.24999
    short_edge_snap_fraction: float = 0.41189
    cut_edge_snap_fraction: float = 0.35
    max_snap_fraction: float = 0.4
    max_bisections: int = 24


@dataclass(frozen=True, eq=False)
class CutMesh:
    """Tetrahedra that do not cross any of the surfaces at which the mesh was cut.

    `nodes` (V, 3) [m]; `node_kinds` (V,): CENTRE, CORNER or CUT; `tets` (T, 4), positively oriented; `is_inside` (T,)
    and `is_on_surface` (V,) with respect to the surface of the last cut.
    """

    nodes: np.ndarray
    node_kinds: np.ndarray
    tets: np.ndarray
    is_inside: np.ndarray
    is_on_surface: np.ndarray

    def select(self, mask: np.ndarray) -> CutMesh:
        """Return the mesh of the tetrahedra marked in `mask` (T,); their nodes are renumbered in the same order."""
        used = np.zeros(len(self.nodes), bool)
        used[self.tets[mask]] = True
        tets = (np.cumsum(used) - 1)[self.tets[mask]]
        return CutMesh(self.nodes[used], self.node_kinds[used], tets, self.is_inside[mask], self.is_on_surface[used])


def build_uncut_mesh(lattice: Lattice) -> CutMesh:
    """Return the mesh of a lattice before the first cut; all tetrahedra are marked as inside."""
    kind, everywhere = np.where(lattice.is_centre, CENTRE, CORNER), np.ones(len(lattice.tets), bool)
    return CutMesh(lattice.nodes, kind, lattice.tets, everywhere, np.zeros(len(kind), bool))


def cut_mesh(
    mesh: CutMesh,
    field: Field,
    fixed_nodes: np.ndarray | None = None,
    settings: IsosurfaceStuffingOptions = IsosurfaceStuffingOptions(),
) -> CutMesh:
    """Return `mesh` split along the zero level set of `field`.

    Nodes near the surface are moved onto the surface, except those marked in `fixed_nodes` (V,), which count as on it.
    """
    nodes = mesh.nodes.copy()
    values = field(nodes)
    edges = _find_crossed_edges(mesh.tets, values)
    at = _find_crossings(field, nodes, edges, values, settings.max_bisections)
    snapped, onto = _select_snapped_nodes(edges, at, _compute_snap_fractions(mesh, edges, settings))
    values[snapped] = 0.0
    loose = snapped if fixed_nodes is None else snapped[~fixed_nodes[snapped]]
    onto = onto if fixed_nodes is None else onto[~fixed_nodes[snapped]]
    start, end = nodes[edges[onto, 0]], nodes[edges[onto, 1]]
    nodes[loose] = start + at[onto, None] * (end - start)

    crossed = values[edges[:, 0]] * values[edges[:, 1]] < 0.0
    edges, at = edges[crossed], at[crossed, None]
    added = nodes[edges[:, 0]] + at * (nodes[edges[:, 1]] - nodes[edges[:, 0]])
    tets, inside = _split_tetrahedra(mesh.tets, np.sign(values).astype(int), edges)
    nodes = np.concatenate([nodes, added])
    flat = (np.append(values, np.zeros(len(added)))[tets] == 0.0).all(axis=1)
    inside[flat] = field(nodes[tets[flat]].mean(axis=1)) < 0.0
    surface = np.append(values == 0.0, np.ones(len(added), bool))
    return CutMesh(nodes, np.append(mesh.node_kinds, np.full(len(added), CUT)), tets, inside, surface)


def _find_crossed_edges(tets: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return edges (E, 2), smaller node number first, whose ends are strictly on different sides of the surface."""
    sides = np.sign(values)[tets]
    crossed = tets[(sides.min(axis=1) < 0) & (sides.max(axis=1) > 0)]
    edges = np.sort(crossed[:, EDGES].reshape(-1, 2), axis=1)
    edges = edges[values[edges[:, 0]] * values[edges[:, 1]] < 0.0]
    keys = np.unique(edges[:, 0] * len(values) + edges[:, 1])
    return np.stack([keys // len(values), keys % len(values)], axis=1)


def _find_crossings(
    field: Field, nodes: np.ndarray, edges: np.ndarray, values: np.ndarray, bisections: int
) -> np.ndarray:
    """Return the position (E,) in (0, 1) of the field's zero on each edge, by bisection."""
    start, along = nodes[edges[:, 0]], nodes[edges[:, 1]] - nodes[edges[:, 0]]
    sign = np.sign(values[edges[:, 0]])
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    for _ in range(bisections):
        middle = 0.5 * (low + high)
        same = sign * field(start + middle[:, None] * along) > 0.0
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def _compute_snap_fractions(pieces: CutMesh, edges: np.ndarray, settings: IsosurfaceStuffingOptions) -> np.ndarray:
    """Return the fraction (E, 2) of each edge, from either end, within which a crossing snaps this end."""
    kinds = pieces.node_kinds[edges]
    share = np.where(kinds[:, 0] == kinds[:, 1], settings.long_edge_snap_fraction, settings.short_edge_snap_fraction)
    share = np.where((kinds == CUT).any(axis=1), settings.cut_edge_snap_fraction, share)
    ends, shortest = pieces.tets[:, EDGES].reshape(-1, 2), np.full(len(pieces.nodes), np.inf)
    np.minimum.at(shortest, ends.ravel(), np.repeat(_compute_lengths(pieces.nodes, ends), 2))
    farthest = settings.max_snap_fraction * shortest[edges]
    return np.minimum(share[:, None], farthest / _compute_lengths(pieces.nodes, edges)[:, None])


def _compute_lengths(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(nodes[edges[:, 1]] - nodes[edges[:, 0]], axis=1)


def _select_snapped_nodes(edges: np.ndarray, fractions: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (S,) to be moved onto the surface, and for each node the edge (S,) whose crossing is its target.

    Closest pairs come first. A moved node removes the crossings of all its edges; its neighbours may then stay.
    """
    node, edge = edges.T.ravel(), np.tile(np.arange(len(edges)), 2)
    share = np.concatenate([fractions, 1.0 - fractions])
    near = np.flatnonzero(share < limit.T.ravel())
    near = near[np.lexsort((edge[near], node[near], share[near]))]
    pulled: dict[int, int] = {}
    for n, e, other in zip(
        node[near].tolist(), edge[near].tolist(), edges.sum(axis=1)[edge[near]].tolist(), strict=True
    ):
        if n not in pulled and other - n not in pulled:
            pulled[n] = e
    return np.array(list(pulled.keys()), int), np.array(list(pulled.values()), int)


def _split_tetrahedra(tets: np.ndarray, side: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra split at the crossings of `edges`, and a mask of those inside; crossings follow the nodes."""
    sides = side[tets]
    inner, outer = (sides < 0).sum(axis=1), (sides > 0).sum(axis=1)
    mixed = (inner > 0) & (outer > 0)
    lone, keys = mixed & ((inner == 1) | (outer == 1)), edges[:, 0] * len(side) + edges[:, 1]

    def get_edge_node(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the node on edge a-b: the crossing, or the end b if b is on the surface."""
        key = np.minimum(a, b) * len(side) + np.maximum(a, b)
        crossing = np.searchsorted(keys, key) + len(side)
        return np.where(side[b] == 0, b, crossing)

    # One corner against the others: a tetrahedron there, and a prism (degenerate if other corners lie on the surface).
    wanted = np.where(inner == 1, -1, 1)[lone]
    turned = np.take_along_axis(tets[lone], LONE_FIRST[np.argmax(sides[lone] == wanted[:, None], axis=1)], axis=1)
    apex, *others = turned.T
    base = [get_edge_node(apex, other) for other in others]
    tips = np.stack([apex, *base], axis=1)
    stumps, stump_of = _split_prisms(np.stack([*base, *others], axis=1))

    # Two corners against two: one wedge on each side.
    pairs = mixed & ~lone
    code = (sides[pairs] < 0) @ (1 << np.arange(4))
    order = np.array([PAIR_FIRST.get(number, [0, 1, 2, 3]) for number in range(16)])[code]
    a, b, c, d = np.take_along_axis(tets[pairs], order, axis=1).T
    ac, ad, bc, bd = get_edge_node(a, c), get_edge_node(a, d), get_edge_node(b, c), get_edge_node(b, d)
    within, _ = _split_prisms(np.stack([a, ac, ad, b, bc, bd], axis=1))
    beyond, _ = _split_prisms(np.stack([c, ac, bc, d, ad, bd], axis=1))

    parts = [
        (tets[~mixed], inner[~mixed] > 0),
        (tips, wanted < 0),
        (stumps, wanted[stump_of] > 0),
        (within, np.ones(len(within), bool)),
        (beyond, np.zeros(len(beyond), bool)),
    ]
    return np.concatenate([part for part, _ in parts]), np.concatenate([inside for _, inside in parts])


def _split_prisms(prisms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra (n, 4) of prisms (P, 6), without those that repeat a node, and the prism (n,) of each."""
    turned = np.take_along_axis(prisms, PRISM_ROTATIONS[np.argmin(prisms, axis=1)], axis=1)
    first = turned[:, [1, 5]].min(axis=1) < turned[:, [2, 4]].min(axis=1)
    tets = np.where(first[:, None, None], turned[:, SPLIT_15], turned[:, SPLIT_24]).reshape(-1, 4)
    ordered = np.sort(tets, axis=1)
    proper = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    return tets[proper], np.repeat(np.arange(len(prisms)), 3)[proper]

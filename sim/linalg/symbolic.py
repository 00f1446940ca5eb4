"""Symbolic factorisation: elimination order and fronts of a sparse matrix.

Duff, Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear equations", ACM Trans. Math. Softw.
9:302-325. Elimination tree: Liu 1990, SIAM J. Matrix Anal. Appl. 11:134-172.
"""

from dataclasses import dataclass

import numpy as np
import pymetis
import scipy.sparse as sp


@dataclass(frozen=True)
class FrontSizes:
    """Sizes of fronts, and division of the elimination into parts.

    Parameters
    ----------
    leaf_size
        Maximum number of unknowns of a subtree that becomes one front.
    max_zeros
        Two fronts are joined if the joined front stores at most this number of zeros, the cost of a dense product.
    max_fronts_above
        Division into parts stops when this number of fronts is in the last part, above the others.
    """

    leaf_size: int = 64
    max_zeros: int = 1000
    max_fronts_above: int = 30


FRONT_SIZES = FrontSizes()
"""Default sizes of the fronts."""


@dataclass(frozen=True, eq=False)
class Front:
    """Front: own unknowns first, ..., stop - 1, and the sorted later unknowns (m,) coupled by their elimination."""

    first: int
    stop: int
    border: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """Own unknowns of the front, followed by its border unknowns."""
        return np.concatenate([np.arange(self.first, self.stop), self.border])


def build_fronts(
    matrix: sp.csc_array, node: np.ndarray, part_count: int = 1, settings: FrontSizes = FRONT_SIZES
) -> tuple[np.ndarray, list[list[Front]]]:
    """Return an order (n,) of the unknowns of a matrix with little fill-in, and the fronts in elimination order.

    Unknowns of one `node` (n,) stay together. The fronts are divided into `part_count` independent parts of about equal
    work, followed by a last part that is coupled to all others.
    """
    number, member, weight = np.unique(node, return_inverse=True, return_counts=True)
    entry = sp.coo_array(matrix)
    first, second = member[entry.row], member[entry.col]
    across = first != second
    links = np.ones(int(across.sum()), np.int8), (first[across], second[across])
    graph = sp.csr_array(sp.coo_array(links, shape=(len(number),) * 2))
    graph += graph.T  # an entry may be zero by round-off, and not stored, on one side only
    order = order_by_dissection(graph)
    groups = _group_nodes(sp.csr_array(graph[order][:, order]), weight[order], settings)
    divided = _split_subtrees(groups, weight[order], part_count, settings.max_fronts_above)
    inner = np.concatenate([np.zeros(0, int), *(groups[number][0] for part in divided for number in part)])
    order, place = order[inner], np.argsort(inner)
    weight = weight[order]
    start = np.cumsum(weight) - weight
    stop = 0

    def build_front(number: int) -> Front:
        nonlocal stop
        own, border = groups[number]
        first, stop = stop, stop + int(weight[place[own]].sum())
        later = np.sort(place[border])
        return Front(first, stop, _join_ranges(start[later], weight[later]))

    fronts = [[build_front(number) for number in part] for part in divided]
    return np.argsort(np.argsort(order)[member], kind="stable"), fronts


def order_by_dissection(graph: sp.csr_array) -> np.ndarray:
    """Return an order (N,) of the nodes of a symmetric graph with little fill-in, by nested dissection.

    Implementation: METIS, Karypis, Kumar 1998, SIAM J. Sci. Comput. 20:359-392.
    """
    if len(graph.indptr) == 1:  # METIS would divide by zero
        return np.zeros(0, int)
    order, _ = pymetis.nested_dissection(pymetis.CSRAdjacency(np.ravel(graph.indptr), np.ravel(graph.indices)))
    return np.asarray(order)


def _join_ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the concatenated ranges start, ..., start + count - 1."""
    return np.repeat(starts - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())


def _build_elimination_tree(graph: sp.csr_array) -> list[int]:
    """Return the elimination tree of an ordered graph: parents (N,), -1 for roots. Liu 1990, algorithm 4.2."""
    count = len(graph.indptr) - 1
    parent, ancestor = [-1] * count, [-1] * count
    starts, neighbours = np.ravel(graph.indptr).tolist(), np.ravel(graph.indices).tolist()
    for node in range(count):
        for below in neighbours[starts[node] : starts[node + 1]]:
            while below != -1 and below < node:
                above, ancestor[below] = ancestor[below], node
                if above == -1:
                    parent[below] = node
                below = above
    return parent


def _group_nodes(graph: sp.csr_array, sizes: np.ndarray, settings: FrontSizes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return groups of nodes that are eliminated together, each with the later nodes that its elimination couples.

    `graph` (N, N) is in elimination order; `sizes` (N,) is the number of unknowns of each node.
    """
    parent, count = _build_elimination_tree(graph), len(sizes)
    below, top = sizes.tolist(), list(range(count))
    for node, above in enumerate(parent):
        if above != -1:
            below[above] += below[node]
    for node in reversed(range(count)):
        if parent[node] != -1 and below[parent[node]] <= settings.leaf_size:
            top[node] = top[parent[node]]
    members: dict[int, list[int]] = {}
    for node in range(count):
        members.setdefault(top[node], []).append(node)

    # Sets of nodes are the bits of integers: a union is one operation.
    alike = {int(unknowns): _encode_nodes(np.flatnonzero(sizes == unknowns), count) for unknowns in np.unique(sizes)}

    def count_unknowns(nodes: int) -> int:
        return sum(unknowns * (nodes & which).bit_count() for unknowns, which in alike.items())

    def count_entries(pivots: int, border: int) -> float:
        return pivots * (0.5 * pivots + border)

    groups: dict[int, tuple[list[int], int, int, int]] = {}
    children: dict[int, list[int]] = {last: [] for last in members}
    for last in sorted(members):
        own = members[last]
        spans = [graph.indices[graph.indptr[node] : graph.indptr[node + 1]] for node in own]
        border = _encode_nodes(np.concatenate(spans), count)
        for child in children[last]:
            border |= groups[child][1]
        border = border >> last + 1 << last + 1
        k, m = int(sizes[own].sum()), count_unknowns(border)
        for child in children[last]:
            inner, _, j, n = groups[child]
            if count_entries(j + k, m) <= count_entries(k, m) + count_entries(j, n) + settings.max_zeros:
                own, k = inner + own, k + j
                del groups[child]
        groups[last] = own, border, k, m
        if border:
            children[(border & -border).bit_length() - 1].append(last)
    return [(np.array(own), _decode_nodes(border, count)) for own, border, _, _ in groups.values()]


def _split_subtrees(
    groups: list[tuple[np.ndarray, np.ndarray]], sizes: np.ndarray, part_count: int, max_above: int
) -> list[list[int]]:
    """Return whole subtrees of groups in `part_count` parts, and the groups above in a last part, in elimination order.

    The root of the heaviest subtree is moved to the last part as long as the total time decreases. The total is the
    time of the last part plus the longest time of the other parts.
    """
    owner = np.zeros(len(sizes), int)
    for number, (own, _) in enumerate(groups):
        owner[own] = number
    entries = [float(sizes[own].sum() * (0.5 * sizes[own].sum() + sizes[border].sum())) for own, border in groups]
    below: list[list[int]] = [[] for _ in groups]
    trees, whole = [], list(entries)
    for number, (_, border) in enumerate(groups):
        if len(border):
            above = int(owner[border.min()])
            below[above].append(number)
            whole[above] += whole[number]
        else:
            trees.append(number)
    shortest, best, top = np.inf, [], []
    while trees and len(top) <= max_above:
        trees.sort(key=lambda number: whole[number], reverse=True)
        shares: list[list[int]] = [[] for _ in range(part_count)]
        loads = [0.0] * part_count
        for number in trees:
            least = loads.index(min(loads))
            shares[least].append(number)
            loads[least] += whole[number]
        length = max(loads) + sum(entries[number] for number in top)
        if length < shortest:
            shortest, best = length, [*shares, list(top)]
        top.append(trees.pop(0))
        trees += below[top[-1]]
    if not best:
        return [[] for _ in range(part_count + 1)]

    def list_subtree(number: int) -> list[int]:
        return [number, *(lower for child in below[number] for lower in list_subtree(child))]

    subtrees = [sorted(lower for number in share for lower in list_subtree(number)) for share in best[:-1]]
    return [*subtrees, sorted(best[-1])]


def _encode_nodes(nodes: np.ndarray, count: int) -> int:
    """Return an integer whose bits mark `nodes`, out of `count` nodes."""
    flags = np.zeros(count, bool)
    flags[nodes] = True
    return int.from_bytes(np.packbits(flags, bitorder="little").tobytes(), "little")


def _decode_nodes(bits: int, count: int) -> np.ndarray:
    """Return the sorted nodes marked by the bits of an integer."""
    packed = np.frombuffer(bits.to_bytes(-(-count // 8), "little"), np.uint8)
    return np.flatnonzero(np.unpackbits(packed, bitorder="little"))

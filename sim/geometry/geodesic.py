"""Distances along a triangulated surface."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csgraph

from .tetmesh import row_keys

STEINER = 4  # extra points on every edge; with 4 of them the paths are at most about 1 % too long
PAIRS = np.array([(i, j) for i in range(3 + 3 * STEINER) for j in range(i)])


def distances(nodes: np.ndarray, triangles: np.ndarray, source: np.ndarray, limit: float) -> np.ndarray:
    """Length (V,) [m] of the shortest path over the surface `triangles` (S, 3) from `source` (3,) to each node.

    Infinite for nodes off the surface or farther than `limit` [m]. Dijkstra's algorithm on a graph of the nodes and
    of further points on the edges, joined straight across each triangle (Lanthier, Maheshwari & Sack 2001). The
    source is joined to the triangles round the node nearest to it.
    """
    size = np.linalg.norm(nodes[triangles] - nodes[np.roll(triangles, 1, axis=1)], axis=2).max()
    near = np.linalg.norm(nodes[triangles] - source, axis=2).min(axis=1) <= limit + size
    used, local = np.unique(triangles[near], return_inverse=True)
    local = local.reshape(-1, 3)
    points, corners = _with_steiner_points(nodes[used], local)

    links = corners[:, PAIRS].reshape(-1, 2)
    nearest = np.linalg.norm(nodes[used] - source, axis=1).argmin()
    first = np.unique(corners[(local == nearest).any(axis=1)])
    points = np.concatenate([points, source[None]])
    start = len(points) - 1
    links = np.concatenate([links, np.stack([first, np.full(len(first), start)], axis=1)])
    links = links[np.unique(row_keys(links), return_index=True)[1]]  # once each: the graph would add doubles up
    length = np.linalg.norm(points[links[:, 0]] - points[links[:, 1]], axis=1)
    graph = coo_array((np.maximum(length, 1e-12), links.T), shape=(start + 1, start + 1)).tocsr()
    along = csgraph.dijkstra(graph, directed=False, indices=start, limit=limit)
    result = np.full(len(nodes), np.inf)
    result[used] = along[: len(used)]
    return result


def _with_steiner_points(nodes: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All points of the graph, the nodes first, and those on the rim of each triangle (S, 3 + 3 * STEINER)."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first, number = np.unique(row_keys(sides), return_index=True, return_inverse=True)
    edges = sides[first]
    share = (np.arange(STEINER) + 1.0) / (STEINER + 1.0)
    start, end = nodes[edges[:, 0]], nodes[edges[:, 1]]
    added = start[:, None] + share[:, None] * (end - start)[:, None]
    on_sides = len(nodes) + number.reshape(-1, 1) * STEINER + np.arange(STEINER)
    return np.concatenate([nodes, added.reshape(-1, 3)]), np.hstack([triangles, on_sides.reshape(len(triangles), -1)])

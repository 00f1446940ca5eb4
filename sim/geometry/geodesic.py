"""Geodesic distances on a triangulated surface."""

import numpy as np
from scipy.sparse import coo_array, csgraph

from .tetmesh import compute_row_keys


def compute_geodesic_distances(
    nodes: np.ndarray, triangles: np.ndarray, source: np.ndarray, max_distance: float, points_per_edge: int = 4
) -> np.ndarray:
    """Return the lengths (V,) [m] of the shortest paths over `triangles` (S, 3) from `source` (3,) to each node.

    The length is infinite for nodes that are not on the surface or farther than `max_distance` [m]. Dijkstra's
    algorithm is applied to a graph of the nodes and of additional points on the edges, connected by straight lines
    within each triangle (Lanthier, Maheshwari & Sack 2001). The source is connected to the triangles around its nearest
    node. With four `points_per_edge` the paths are at most about 1 % too long.
    """
    size = np.linalg.norm(nodes[triangles] - nodes[np.roll(triangles, 1, axis=1)], axis=2).max()
    near = np.linalg.norm(nodes[triangles] - source, axis=2).min(axis=1) <= max_distance + size
    used, local = np.unique(triangles[near], return_inverse=True)
    points, corners = _add_steiner_points(nodes[used], local, points_per_edge)

    links = corners[:, np.array([(i, j) for i in range(3 + 3 * points_per_edge) for j in range(i)])].reshape(-1, 2)
    nearest = np.linalg.norm(nodes[used] - source, axis=1).argmin()
    first = np.unique(corners[(local == nearest).any(axis=1)])
    points = np.concatenate([points, source[None]])
    start = len(points) - 1
    links = np.concatenate([links, np.stack([first, np.full(len(first), start)], axis=1)])
    links = links[np.unique(compute_row_keys(links), return_index=True)[1]]  # unique: the graph would sum duplicates
    length = np.linalg.norm(points[links[:, 0]] - points[links[:, 1]], axis=1)
    graph = coo_array((np.maximum(length, 1e-12), links.T), shape=(start + 1, start + 1)).tocsr()
    along = csgraph.dijkstra(graph, directed=False, indices=start, limit=max_distance)
    result = np.full(len(nodes), np.inf)
    result[used] = along[: len(used)]
    return result


def _add_steiner_points(nodes: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of the graph, nodes first, and the numbers of the points on each triangle (S, 3 + 3 count)."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first, number = np.unique(compute_row_keys(sides), return_index=True, return_inverse=True)
    edges, share = sides[first], (np.arange(count) + 1.0) / (count + 1.0)
    start, end = nodes[edges[:, 0]], nodes[edges[:, 1]]
    added = start[:, None] + share[:, None] * (end - start)[:, None]
    on_sides = len(nodes) + number.reshape(-1, 1) * count + np.arange(count)
    return np.concatenate([nodes, added.reshape(-1, 3)]), np.hstack([triangles, on_sides.reshape(len(triangles), -1)])

"""The part of tetrahedra that lies under a plane, exactly: as smaller tetrahedra, in corner coordinates."""

from __future__ import annotations

import numpy as np

# A part's own corners lie on edges of the tetrahedron, whose corners are numbered from the lowest to the highest:
# (i, j) is where the plane meets the edge from i to j, and (i, i) corner i itself. By how many corners are under it.
ENDS = {
    1: np.array([[0, 0], [0, 1], [0, 2], [0, 3]]),
    2: np.array([[0, 0], [0, 2], [0, 3], [1, 1], [1, 2], [1, 3]]),
    3: np.array([[0, 0], [1, 1], [2, 2], [0, 3], [1, 3], [2, 3]]),
}
# A prism between the triangles 0, 1, 2 and 3, 4, 5 is three tetrahedra.
PRISM = np.array([[0, 1, 2, 5], [0, 1, 4, 5], [0, 3, 4, 5]])
PARTS = {1: np.array([[0, 1, 2, 3]]), 2: PRISM, 3: PRISM}


def parts_under(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra that together are what lies under a plane, none of them inside another.

    height (n, 4) [m] of the corners of n tetrahedra above the plane, which has one to three of them below zero. The
    tetrahedron (m,) that each part belongs to, and the corner coordinates (m, 4, 4) of each part's own corners: the
    part has |determinant| of the whole's volume, which changes continuously as the plane moves.
    """
    order = np.argsort(height, axis=1)
    corner, sorted_height = np.eye(4)[order], np.take_along_axis(height, order, axis=1)
    under = (height < 0.0).sum(axis=1)
    owners, parts = [np.zeros(0, int)], [np.zeros((0, 4, 4))]
    for count, ends in ENDS.items():
        mine = np.flatnonzero(under == count)
        low, high = ends.T
        below, above = sorted_height[mine][:, low], sorted_height[mine][:, high]
        whole_way = np.where(low == high, 1.0, below - above)
        way = np.where(low == high, 0.0, below / whole_way)[:, :, None]
        points = (1.0 - way) * corner[mine][:, low] + way * corner[mine][:, high]
        found = points[:, PARTS[count]]
        owners.append(np.repeat(mine, found.shape[1]))
        parts.append(found.reshape(-1, 4, 4))
    return np.concatenate(owners), np.concatenate(parts)

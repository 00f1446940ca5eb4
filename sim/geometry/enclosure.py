"""Whether points lie inside a closed surface."""

from __future__ import annotations

import numpy as np


def enclosed(points: np.ndarray, nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) [m] lie inside the surface of triangles (S, 3) of nodes (N, 3) [m], outwards: (n,) bool.

    By the solid angle that it fills: van Oosterom, Strackee 1983, "The solid angle of a plane triangle", IEEE Trans.
    Biomed. Eng. 30:125-126, equation 8.
    """
    out = np.empty(len(points), bool)
    for row, point in enumerate(points):
        a, b, c = np.moveaxis(nodes[triangles] - point, 1, 0)
        x, y, z = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
        triple = np.einsum("si,si->s", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("si,si->s", one, other) for one, other in ((a, b), (b, c), (c, a)))
        out[row] = np.arctan2(triple, x * y * z + ab * z + bc * x + ca * y).sum() > np.pi
    return out

"""Closest point of a triangulated surface, implemented in NumPy."""

from typing import NamedTuple

import numpy as np

DISTANCE_TOLERANCE = 1e-9  # Relative difference of one distance computed in two ways.
BLOCK_SIZE = 128  # Points compared with shared triangles at once: more only take more memory.


class ClosestPoints(NamedTuple):
    """Closest points (B, 3) [m], with their triangles (B,) and barycentric weights (B, 3)."""

    point: np.ndarray
    triangle: np.ndarray
    weights: np.ndarray


def find_closest_points(points: np.ndarray, corners: np.ndarray) -> ClosestPoints:
    """Return the closest points to `points` (B, 3) [m] on triangles with corners (S, 3, 3) or (B, S, 3, 3) [m].

    The closest point of a triangle is the projection to its plane if this is inside, else the closest point of an edge.
    For triangles without area, only the edges are used. For corners (S, 3, 3), distances to centroids select the few
    triangles that may be closest to each point.
    """
    if corners.ndim == 3:
        middle, reach = compute_bounding_balls(corners)
        parts = []
        for first in range(0, len(points), BLOCK_SIZE):
            some = points[first : first + BLOCK_SIZE]
            near = _list_candidates(some, middle, reach)
            found = find_closest_points(some, corners[near])
            parts.append(found._replace(triangle=near[np.arange(len(near)), found.triangle]))
        return parts[0] if len(parts) == 1 else ClosestPoints(*map(np.concatenate, zip(*parts, strict=True)))
    edge = np.roll(corners, -1, axis=2) - corners
    arm = points[:, None, None] - corners
    square = np.einsum("bsei,bsei->bse", edge, edge)
    share = np.einsum("bsei,bsei->bse", arm, edge) / np.where(square > 0.0, square, 1.0)
    share = np.clip(share, 0.0, 1.0)
    off, normal = arm - share[..., None] * edge, np.cross(edge[:, :, 0], edge[:, :, 1])
    twice = np.einsum("bsi,bsi->bs", normal, normal)  # the square of twice the area
    twice = np.where(twice > 0.0, twice, np.inf)[..., None]
    # A corner's weight is the area spanned by the projection and the opposite edge.
    spanned = np.einsum("bsi,bsei->bse", normal, np.cross(edge, arm)) / twice
    inner = np.roll(spanned, -1, axis=2)
    inside = (inner > 0.0).all(axis=2)
    height = np.einsum("bsi,bsi->bs", normal, arm[:, :, 0]) ** 2 / twice[..., 0]
    far = np.concatenate([np.einsum("bsei,bsei->bse", off, off), np.where(inside, height, np.inf)[..., None]], axis=2)
    triangle, kind = np.divmod(far.reshape(len(far), -1).argmin(axis=1), 4)
    row = np.arange(len(far))
    weights, on_edge = inner[row, triangle], kind < 3
    some, start = row[on_edge], kind[on_edge]
    along = share[some, triangle[on_edge], start]
    weights[on_edge] = 0.0
    weights[some, start] = 1.0 - along
    weights[some, (start + 1) % 3] = along
    return ClosestPoints(np.einsum("bc,bci->bi", weights, corners[row, triangle]), triangle, weights)


def compute_bounding_balls(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids (S, 3) and radii (S,) [m] of balls that each contain a triangle with corners (S, 3, 3) [m]."""
    middle = corners.mean(axis=1)
    return middle, np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)


def _list_candidates(points: np.ndarray, centres: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the triangles (B, k) that may be closest to each point; `centres` and `radii` are their bounding balls.

    A triangle is omitted if no point of this triangle can be closer than the nearest centroid.

    Each row starts with the possibly closest triangles in ascending order, so that of equally close triangles the first
    is found. The remainder of the row repeats its first triangle.
    """
    x, y, z = (points[:, axis, None] - centres[:, axis] for axis in range(3))
    away = np.sqrt(x * x + y * y + z * z)
    maybe = ~(away - radii > (1.0 + DISTANCE_TOLERANCE) * away.min(axis=1, keepdims=True))
    row, triangle = np.divmod(np.flatnonzero(maybe), len(centres))
    count = np.bincount(row, minlength=len(points))
    first = np.cumsum(count) - count
    near = np.repeat(triangle[first][:, None], count.max(), axis=1)
    near[row, np.arange(len(row)) - first[row]] = triangle
    return near

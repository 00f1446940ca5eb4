"""Where a ball comes to rest on a triangulated surface: exact first contact with faces, edges and vertices."""

from __future__ import annotations

import numpy as np

from ..errors import InputError

# Of the radius: rounding must not let a ball slip between a face and its edge.
SLACK = 1e-9


def resting_tip(
    nodes: np.ndarray, triangles: np.ndarray, through: np.ndarray, inward: np.ndarray, radius: float
) -> np.ndarray:
    """Return the tip (3,) [m] of a ball that comes down a line until it first touches a surface.

    The ball comes from infinitely far; its centre stays on the line. Its tip is its lowest point along `inward`, which
    need not be the point that touches. The ball enters a triangle's neighbourhood of its own radius: a plate, three
    cylinders and three balls (Ericson 2005, "Real-Time Collision Detection", section 5.5.6); the first of them counts.

    Parameters
    ----------
    nodes, triangles
        Surface: positions (V, 3) [m] and vertex numbers (F, 3). Triangles without area count as edges.
    through, inward
        Any point (3,) [m] of the line, and the unit direction (3,) in which the ball moves.
    radius
        Of the ball [m].

    Raises
    ------
    InputError
        A ball that never touches the surface on its way.
    """
    across = nodes - through
    along = across @ inward
    across = across - np.outer(along, inward)
    least, most = (bound(across[triangles], axis=1) for bound in (np.min, np.max))
    near = triangles[((least <= radius) & (most >= -radius)).all(axis=1)]
    corners = nodes[near] - through
    first = min(_vertices(corners, inward, radius), _edges(corners, inward, radius), _faces(corners, inward, radius))
    if first == np.inf:
        raise InputError(
            f"a ball of {1e3 * radius:.3g} mm passes the surface by on the line through "
            f"{np.round(1e3 * through, 1)} mm: choose a line that meets the surface."
        )
    return through + (first + radius) * inward


def _vertices(corners: np.ndarray, inward: np.ndarray, radius: float) -> float:
    """How far along the line [m] the centre is as the ball first touches a corner (F, 3, 3) [m]; inf: never."""
    point = corners.reshape(-1, 3)
    along = point @ inward
    room = radius**2 - (np.einsum("pi,pi->p", point, point) - along**2)
    return _first(along - np.sqrt(np.maximum(room, 0.0)), room >= 0.0)


def _edges(corners: np.ndarray, inward: np.ndarray, radius: float) -> float:
    """The same of what lies between the ends of the triangles' edges."""
    start = corners.reshape(-1, 3)
    edge = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    square = np.einsum("ei,ei->e", edge, edge)
    unit = edge / np.sqrt(np.where(square > 0.0, square, 1.0))[:, None]
    slope, offset = unit @ inward, np.einsum("ei,ei->e", unit, start)
    # What is left of direction and way to the start, square to the edge.
    down, away = inward - slope[:, None] * unit, start - offset[:, None] * unit
    steep, half = np.einsum("ei,ei->e", down, down), np.einsum("ei,ei->e", down, away)
    room = half**2 - steep * (np.einsum("ei,ei->e", away, away) - radius**2)
    crosses = (square > 0.0) & (steep > SLACK) & (room >= 0.0)
    distance = (half - np.sqrt(np.maximum(room, 0.0))) / np.where(crosses, steep, 1.0)
    place, slack = distance * slope - offset, SLACK * radius
    return _first(distance, crosses & (place >= -slack) & (place <= np.sqrt(square) + slack))


def _faces(corners: np.ndarray, inward: np.ndarray, radius: float) -> float:
    """The same of the triangles' insides, whichever side the ball comes from."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(ab, ac)
    twice = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(twice > 0.0, twice, 1.0)[:, None]
    facing = normal @ inward
    meets = np.abs(facing) > SLACK
    distance = np.einsum("fi,fi->f", normal, a) / np.where(meets, facing, 1.0) - radius / np.where(
        meets, np.abs(facing), 1.0
    )
    foot = distance[:, None] * inward + radius * np.sign(facing)[:, None] * normal - a
    first, second = np.cross(foot, ac), np.cross(ab, foot)
    share = np.stack([np.einsum("fi,fi->f", normal, each) for each in (first, second)])
    slack = SLACK * twice
    inside = (share >= -slack).all(axis=0) & (share.sum(axis=0) <= twice + slack)
    return _first(distance, meets & inside)


def _first(distance: np.ndarray, counts: np.ndarray) -> float:
    return float(np.min(distance, where=counts, initial=np.inf))

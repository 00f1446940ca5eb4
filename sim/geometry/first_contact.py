"""First contact of a ball with a triangulated surface: exact for faces, edges and vertices."""

import numpy as np

from ..errors import InputError

TOLERANCE = 1e-9  # Tolerance relative to the radius, so that by rounding no ball slips between a face and its edge.


def find_resting_tip(
    nodes: np.ndarray, triangles: np.ndarray, line_point: np.ndarray, inward: np.ndarray, radius: float
) -> np.ndarray:
    """Return the tip (3,) [m] of one ball, as `find_resting_tips`, for nodes (V, 3) [m] and `line_point` (3,) [m]."""
    return find_resting_tips(nodes[None], triangles, line_point[None], inward, np.array([radius]))[0]


def find_resting_tips(
    nodes: np.ndarray, triangles: np.ndarray, line_point: np.ndarray, inward: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return the tips (B, 3) [m] of balls, each moved along a line until its first contact with its own surface.

    A ball comes from infinity; its centre stays on the line. Its tip is its lowest point along `inward`, which need not
    be the contact point. Contact occurs when the centre first enters a triangle enlarged by the radius: a plate, three
    cylinders and three balls (Ericson 2005, "Real-Time Collision Detection", section 5.5.6).

    Parameters
    ----------
    nodes, triangles
        Vertex positions (B, V, 3) [m] of the B surfaces, and their common vertex numbers (F, 3). Triangles without area
        count as edges.
    line_point, inward
        Any point (B, 3) [m] on each line, and the unit direction (3,) in which all balls move.
    radius
        Radius of each ball (B,) [m].

    Raises
    ------
    InputError
        The path of a ball misses its surface.
    """
    across = nodes - line_point[:, None]
    across = across - (across @ inward)[..., None] * inward
    least, most = (bound(across[:, triangles], axis=2) for bound in (np.min, np.max))
    reach = radius[:, None, None]
    case, face = np.nonzero(((least <= reach) & (most >= -reach)).all(axis=2))
    corners = nodes[case[:, None], triangles[face]] - line_point[case, None]
    first = np.full(len(nodes), np.inf)
    for distance in (
        part(corners, inward, radius[case, None])
        for part in (_compute_vertex_paths, _compute_edge_paths, _compute_face_paths)
    ):
        np.minimum.at(first, case, distance.min(axis=1))
    passing = np.flatnonzero(first == np.inf)
    if len(passing):
        raise InputError(
            f"the path of the ball of radius {1e3 * radius[passing[0]]:.3g} mm through "
            f"{np.round(1e3 * line_point[passing[0]], 1)} mm misses the surface: choose another path."
        )
    return line_point + (first + radius)[:, None] * inward


def _compute_vertex_paths(corners: np.ndarray, inward: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the path of the centre (M, 3) [m] to the first contact with each corner (M, 3, 3) [m]; inf: no contact."""
    along = corners @ inward
    room = radius**2 - (np.einsum("mpi,mpi->mp", corners, corners) - along**2)
    return np.where(room >= 0.0, along - np.sqrt(np.maximum(room, 0.0)), np.inf)


def _compute_edge_paths(corners: np.ndarray, inward: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the path of the centre (M, 3) [m] to the first contact with the interior of each edge; inf: no contact."""
    edge = np.roll(corners, -1, axis=1) - corners
    square = np.einsum("mei,mei->me", edge, edge)
    unit = edge / np.sqrt(np.where(square > 0.0, square, 1.0))[..., None]
    slope, offset = unit @ inward, np.einsum("mei,mei->me", unit, corners)
    # Components of the direction, and of the vector to the start, perpendicular to the edge.
    down, away = inward - slope[..., None] * unit, corners - offset[..., None] * unit
    steep, half = np.einsum("mei,mei->me", down, down), np.einsum("mei,mei->me", down, away)
    room = half**2 - steep * (np.einsum("mei,mei->me", away, away) - radius**2)
    crosses = (square > 0.0) & (steep > TOLERANCE) & (room >= 0.0)
    distance = (half - np.sqrt(np.maximum(room, 0.0))) / np.where(crosses, steep, 1.0)
    place, slack = distance * slope - offset, TOLERANCE * radius
    return np.where(crosses & (place >= -slack) & (place <= np.sqrt(square) + slack), distance, np.inf)


def _compute_face_paths(corners: np.ndarray, inward: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the path of the centre (M, 1) [m] to the first contact with each triangle's interior, on either side."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(ab, ac)
    twice = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(twice > 0.0, twice, 1.0)[:, None]
    facing = normal @ inward
    meets = np.abs(facing) > TOLERANCE
    ahead, off = np.einsum("mi,mi->m", normal, a), radius[:, 0]
    distance = ahead / np.where(meets, facing, 1.0) - off / np.where(meets, np.abs(facing), 1.0)
    foot = distance[:, None] * inward + (off * np.sign(facing))[:, None] * normal - a
    first, second = np.cross(foot, ac), np.cross(ab, foot)
    share = np.stack([np.einsum("mi,mi->m", normal, each) for each in (first, second)])
    slack = TOLERANCE * twice
    inside = (share >= -slack).all(axis=0) & (share.sum(axis=0) <= twice + slack)
    return np.where(meets & inside, distance, np.inf)[:, None]

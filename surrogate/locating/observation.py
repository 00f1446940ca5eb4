"""Observations of a brain, checked against its anatomy: moved points, a point cloud of the surface, tool tips."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from sim.geometry.locate import LocatedPoints, locate
from sim.geometry.surface import compute_vertex_normals, normalise_vectors

from ..array_functions import compute_squared_distances
from .evidence import SHIFT_ERROR, SIGMA, Evidence, build_motion_evidence

UNIT_ERRORS = (  # Likely unit errors: factor that brings the points to the cortex, hint to the user.
    (1.0, ""),
    (1e-3, "if they were a thousandth of that: files are in mm, arrays in metres"),
    (1e3, "if they were a thousand times of that: files are in mm, arrays in metres"),
    (10.0, "if they were ten times of that: they look like centimetres"),
    (1e-2, "if they were a hundredth of that: they look like an array of centimetres"),
    (25.4, "if they were 25.4 times of that: they look like inches"),
)
# Likely axis errors: signs of x, y and z that bring the points to the cortex, hint to the user.
FRAME_ERRORS = (((1.0, 1.0, 1.0), ""), ((-1.0, -1.0, 1.0), "if x and y were turned: they are LPS"))
MAX_POINTS = 400
"""Maximum number of points used, evenly chosen; more points add little, as errors of neighbours are correlated."""


@dataclass(frozen=True)
class ObservationLimits:
    """Limits of a plausible observation; values outside are rejected."""

    min_points: int = 6  # Minimum number of points, and of distinct positions.
    min_spread_ratio: float = 0.05  # Smallest ratio of the spread of points across a line to that along it.
    near_distance: float = 6e-3  # Largest distance of at least half of the points from the open cortex [m].
    far_distance: float = 12e-3  # Largest distance of a point from the open cortex [m]; points beyond are outliers.
    # `near_distance` for positions on the displaced surface [m]: drained brains sink by over a centimetre.
    near_distance_now: float = 18e-3
    far_distance_now: float = 30e-3  # `far_distance` for positions on the displaced surface, and for tool tips [m].
    place_tolerance: float = 1e-3  # Distance below which points count as one [m].
    max_coordinate: float = 1e6  # Largest coordinate [m].
    max_motion: float = 0.025  # Largest median motion of a brain [m].
    max_rigid_error: float = 0.02  # Largest rigid error of a tracker [m].
    min_sigma: float = 0.01e-3  # Smallest error of a point [m]; a smaller one is probably in metres instead of mm.
    min_motion: float = 1e-9  # Smallest motion that is not zero [m].
    # Largest median error [m]: with more, points give no information about motions of a few millimetres.
    max_sigma: float = 0.01
    # Largest ratio of the points' span to that of the open cortex, or its inverse; beyond it units are wrong.
    max_span_ratio: float = 6.0


LIMITS = ObservationLimits()


@dataclass(frozen=True, eq=False)
class Observation:
    """Observed points and tool tips, in metres and RAS.

    Parameters
    ----------
    now
        Observed positions (n, 3), which include the rigid error.
    rest
        Positions (n, 3) of the same points in the scan; None: a surface cloud without correspondences.
    sigma
        Standard deviation (n,) of each point's non-rigid error along each axis; None: `SIGMA`.
    tips
        Positions (k, 3) of tool tips that touch the surface.
    rigid
        Standard deviation of the rigid error's translation along each axis, common to all points.
    checked
        True if the registration was checked on structures that do not move, such as skull landmarks. Then no slip
        beyond `rigid` is assumed.

    Examples
    --------
    >>> from scenes import open_theatre
    >>> from surrogate import Observation
    >>> theatre = open_theatre(device="cpu")
    >>> rest = theatre.anatomy.mesh.nodes[np.unique(theatre.anatomy.open_surface)]
    >>> dent = 3e-3 * np.exp(-((theatre.site.compute_axis_distance(rest) / 0.01) ** 2))  # 3 mm at its centre
    >>> location = theatre.locator.locate(Observation(now=rest + dent[:, None] * theatre.site.axis, rest=rest))
    >>> print(f"{1e3 * np.linalg.norm(location.centroid):.1f} mm, error <= {1e3 * location.p95:.1f} mm (95 %)")
    0.5 mm, error <= 0.6 mm (95 %)
    """

    now: np.ndarray
    rest: np.ndarray | None = None
    sigma: np.ndarray | None = None
    tips: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    rigid: float = SHIFT_ERROR
    checked: bool = False

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (n,) [m] of the points' non-rigid errors, `SIGMA` by default."""
        return np.full(len(self.now), SIGMA) if self.sigma is None else self.sigma


def to_evidence(anatomy: Anatomy, observation: Observation) -> Evidence:
    """Check an observation and convert it to evidence, with the brain undeformed.

    Raises
    ------
    InputError
        Values are not finite or out of range, there are too few points, points are on a line, or a sigma is smaller
        than any tracker's or too large to be informative. The rigid error is larger than any tracker's; motions are
        larger than any brain's or too small to be observed. Points are far from the brain's surface; the message gives
        the likely reason: units, LPS instead of RAS, another anatomy.
    """
    _check_observation(observation)
    some = choose_point_numbers(len(observation.now))
    if observation.rest is None:
        where, near, far = observation.now[some], LIMITS.near_distance_now, LIMITS.far_distance_now
    else:
        where, near, far = observation.rest[some], LIMITS.near_distance, LIMITS.far_distance
    off = _compute_surface_distances(anatomy, where)
    if _is_mostly_far(off, near):
        raise InputError(_describe_mismatch(anatomy, where, float(np.median(off)), near))
    _check_spread(where, off <= far)
    if observation.rest is not None:
        _check_motions(np.linalg.norm(observation.now - observation.rest, axis=1)[some])
    for number, away in enumerate(_compute_surface_distances(anatomy, observation.tips), start=1):
        if away > LIMITS.far_distance_now:
            raise InputError(
                f"tip {number} is {1e3 * away:.0f} mm from the open cortex, so that it cannot touch it: give "
                "millimetres, RAS, or leave it out."
            )
    here = np.zeros_like(anatomy.mesh.nodes)
    return to_deformed_evidence(anatomy, observation, some[off <= far], here, lambda at: np.zeros_like(at))


def choose_point_numbers(point_count: int) -> np.ndarray:
    """Select the indices (k,) of at most `MAX_POINTS` points, evenly spread over `point_count`."""
    return np.unique(np.linspace(0, point_count - 1, min(point_count, MAX_POINTS)).round().astype(int))


def to_deformed_evidence(
    anatomy: Anatomy, observation: Observation, point_numbers: np.ndarray, motion: np.ndarray,
    bias: Callable[[np.ndarray], np.ndarray],
) -> Evidence:  # fmt: skip
    """Convert an observation to evidence, with the brain deformed by `motion` (V, 3) [m].

    Only the points with indices `point_numbers` (k,) are used. Points without an undeformed position, and tips, are
    matched to the closest surface point, and give the surface's motion along the normal. `bias` maps positions (n, 3)
    to the estimated rigid error (n, 3) [m]. Tips are numbered after the points.
    """
    parts, count = [], len(observation.now)
    cloud, number = observation.tips, count + np.arange(len(observation.tips))
    sigma = np.full(len(observation.tips), SIGMA)
    if observation.rest is not None:
        here = observation.rest[point_numbers]
        moved = build_motion_evidence(
            locate(anatomy.mesh, here),
            here,
            observation.now[point_numbers] - here,
            observation.sigmas[point_numbers],
            observation.rigid,
        )
        parts.append(replace(moved, point=point_numbers[moved.point]))
    else:
        cloud, number = np.concatenate([observation.now[point_numbers], cloud]), np.concatenate([point_numbers, number])
        sigma = np.concatenate([observation.sigmas[point_numbers], sigma])
    if len(cloud):
        along = _build_normal_rows(anatomy, cloud, sigma, number, motion, bias)
        parts.append(replace(along, shift_sigma=observation.rigid))
    return parts[0] if len(parts) == 1 else _join_evidence(parts)


def _build_normal_rows(
    anatomy: Anatomy, points: np.ndarray, sigma: np.ndarray, number: np.ndarray, motion: np.ndarray,
    bias: Callable[[np.ndarray], np.ndarray],
) -> Evidence:  # fmt: skip
    """Build one row per point, with its `number` (n,): surface displacement along the deformed normal."""
    triangles, nodes = anatomy.open_surface, anatomy.mesh.nodes
    corners = (nodes + motion)[triangles]
    _, triangle, weights = find_closest_points(points - bias(points), corners)
    vertices = triangles[triangle]
    # At an edge two triangles are equally near: normals of vertices do not depend on which one is found.
    normal = normalise_vectors(
        np.einsum("nc,nci->ni", weights, compute_vertex_normals(nodes + motion, triangles)[vertices])
    )
    at = np.einsum("nc,nci->ni", weights, nodes[vertices])
    # A fourth vertex of weight 0 gives the layout of a tetrahedron.
    place = LocatedPoints(np.column_stack([vertices, vertices[:, 0]]), np.column_stack([weights, np.zeros(len(at))]))
    value = np.einsum("ni,ni->n", points - at, normal)
    return Evidence(place, at, normal, value, sigma, number)


def _join_evidence(parts: list[Evidence]) -> Evidence:
    def join_fields(get_part, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {name: np.concatenate([getattr(get_part(part), name) for part in parts]) for name in names}

    place = LocatedPoints(**join_fields(lambda part: part.location, ("vertices", "weights")))
    arrays = join_fields(lambda part: part, ("positions", "axis", "motion", "sigma", "point"))
    return Evidence(location=place, shift_sigma=parts[0].shift_sigma, **arrays)


def _check_observation(observation: Observation) -> None:
    arrays = {"now": observation.now, "tips": observation.tips}
    if observation.rest is not None:
        arrays["rest"] = observation.rest
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] != 3:
            raise InputError(f"`{name}` of an observation is no array of shape (n, 3): give one, in metres.")
    count, sigma = len(observation.now), np.asarray(observation.sigmas)
    if observation.rest is not None and len(observation.rest) != count:
        raise InputError(f"{count} points have {len(observation.rest)} places at rest: give one for each.")
    if sigma.shape != (count,):
        raise InputError(f"{count} points have a sigma of shape {sigma.shape}: give one number for each point.")
    for name, array in {**arrays, "sigma": sigma}.items():
        if not (np.abs(array) < LIMITS.max_coordinate).all():
            raise InputError(
                f"`{name}` has a value that is not finite, or beyond {LIMITS.max_coordinate:,.0f} m: leave such points "
                "out."
            )
    if count < LIMITS.min_points:
        raise InputError(
            f"{count} points say too little: give at least {LIMITS.min_points}, spread over the open cortex."
        )
    if not (sigma > 0.0).all():
        raise InputError("a sigma is not positive: give each point the standard deviation of its error [mm].")
    if sigma.min() < LIMITS.min_sigma:
        raise InputError(
            f"a sigma is {1e3 * sigma.min():.2g} mm, which no tracker has: give each point the standard deviation of "
            "its error in millimetres, rather than metres."
        )
    if np.median(sigma) > LIMITS.max_sigma:
        raise InputError(
            f"half of the points have a sigma of {1e3 * np.median(sigma):.3g} mm or more, and so say nothing of a "
            f"brain. Give standard deviations of up to {1e3 * LIMITS.max_sigma:g} mm, or leave these points out."
        )
    if not 0.0 <= observation.rigid <= LIMITS.max_rigid_error:
        raise InputError(
            f"a rigid error of {1e3 * observation.rigid:g} mm is none that a tracker has: give its standard deviation "
            f"along each axis, from 0 to {1e3 * LIMITS.max_rigid_error:g} mm."
        )


def _check_motions(length: np.ndarray) -> None:
    """Raise InputError for implausible motion lengths (n,) [m]: too large for a brain, or given in another unit.

    Lengths of 0 are accepted, as for a brain that has not moved.
    """
    if np.median(length) > LIMITS.max_motion:
        raise InputError(
            f"half of the points move by more than {1e3 * np.median(length):.0f} mm, which no brain does: give motions "
            "in millimetres, rather than centimetres or new positions."
        )
    if LIMITS.min_motion < length.max() < 1e-3 * LIMITS.max_motion:
        raise InputError(
            f"no point moves by more than {1e3 * length.max():.2g} mm, below any noise: give motions in millimetres, "
            "rather than metres. If nothing moved, give zeros."
        )


def _check_spread(points: np.ndarray, is_near: np.ndarray) -> None:
    """Raise InputError if points (n, 3) [m] have too few distinct positions, or if those of `is_near` are on a line."""
    places = len(np.unique(np.round(points / LIMITS.place_tolerance), axis=0))
    if places < LIMITS.min_points:
        raise InputError(
            f"{places} places a millimetre apart say too little: give {LIMITS.min_points} at least, spread over the "
            "open cortex."
        )
    some = points[is_near]
    along, across, _ = np.linalg.svd(some - some.mean(axis=0), compute_uv=False)
    if not across > LIMITS.min_spread_ratio * along:
        raise InputError("the points lie on a line: spread them over the open cortex.")


def _compute_surface_distances(anatomy: Anatomy, points: np.ndarray) -> np.ndarray:
    """Compute distances (n,) [m] from the open cortex; below `LIMITS.near_distance`, from the nearest vertex."""
    nodes, triangles = anatomy.mesh.nodes, anatomy.open_surface
    away = np.sqrt(compute_squared_distances(points, nodes[np.unique(triangles)]).min(axis=1))
    far = np.flatnonzero(away > LIMITS.near_distance)
    if len(far):
        away[far] = np.linalg.norm(find_closest_points(points[far], nodes[triangles]).point - points[far], axis=1)
    return away


def _is_mostly_far(distances: np.ndarray, limit: float) -> bool:
    """Return True if more than half of the distances `distances` (n,) exceed `limit` [m]."""
    return bool(np.count_nonzero(distances > limit) > 0.5 * len(distances))


def _describe_mismatch(anatomy: Anatomy, points: np.ndarray, distance: float, limit: float) -> str:
    """Describe the likely reason why half of the points (n, 3) are beyond `limit` [m] from the open cortex."""
    start = f"half of the points lie more than {1e3 * distance:.3g} mm from the open cortex"
    for (scale, unit_meant), (turned, frame_meant) in product(UNIT_ERRORS, FRAME_ERRORS):
        if not _is_mostly_far(_compute_surface_distances(anatomy, scale * points * turned), limit):
            meant = " and ".join(filter(None, (unit_meant, frame_meant)))
            return f"{start}, and would lie on it {meant}. Give mm and RAS."
    span, own = (float(np.linalg.norm(np.ptp(some, axis=0))) for some in (points, open_cortex(anatomy).corners))
    if not own / LIMITS.max_span_ratio < span < own * LIMITS.max_span_ratio:
        return f"{start}. They span {1e3 * span:.3g} mm, and it {1e3 * own:.3g} mm: check units. Give mm and RAS."
    return f"{start}: they are of another brain or frame. Give the scan's own RAS, in millimetres."

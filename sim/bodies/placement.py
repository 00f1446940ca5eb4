"""Positions in a head: cortex that is accessible through the skull, craniotomies, and anatomical directions."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from ..errors import InputError

AXES = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))
"""Names of the negative and positive direction of each RAS axis."""


BLOCK_SIZE = 256  # points per block in the test against all hull planes


@dataclass(frozen=True)
class Placement:
    """Limits of brainstem, craniotomy and midline.

    Parameters
    ----------
    brainstem_radius
        Radius of the brainstem around the lowest point, as a fraction of the brain's height. In the template this is
        21 mm and covers the medulla and adjacent tissue.
    max_hull_depth
        Maximum depth of accessible cortex under the convex hull [m]; deeper cortex is in a fissure.
    min_height
        Minimum height of a craniotomy, as a fraction of the brain's height; it may be lower if the tumour is lower.
    max_surface_distance
        Maximum distance of a given point from the surface [m], so that the intended cortex is unambiguous.
    max_outside_distance
        Maximum distance of a given point outside the brain [m], since coordinates read from images are inexact.
    midline_half_width
        Half of the width of the midline strip, as a fraction of the brain's width.
    min_open_nodes
        Minimum number of nodes in a craniotomy, to support a tool.
    """

    brainstem_radius: float = 0.15
    max_hull_depth: float = 6e-3
    min_height: float = 0.3
    max_surface_distance: float = 20e-3
    max_outside_distance: float = 5e-3
    midline_half_width: float = 0.03
    min_open_nodes: int = 6


@dataclass(frozen=True, eq=False)
class TumourPiece:
    """Connected component of a tumour: volume [m^3], centre (3,) [m], and surface points (n, 3) [m]."""

    volume: float
    centre: np.ndarray
    surface: np.ndarray


def describe_side(point: np.ndarray, low: np.ndarray, high: np.ndarray, settings: Placement = Placement()) -> str:
    """Return a description of a point (3,) in a brain's box `low` to `high` (RAS), such as "left anterior superior".

    "left" or "right" appears outside the midline strip; words for the other two axes appear in the outer thirds.
    """
    share, words = (np.asarray(point) - low) / (high - low), []
    for axis, names in enumerate(AXES):
        middle = settings.midline_half_width if axis == 0 else 1.0 / 6.0
        if abs(share[axis] - 0.5) > middle:
            words.append(names[int(share[axis] > 0.5)])
        elif axis == 0:
            words.append("midline")
    return " ".join(words)


def find_reachable_site(cortex: np.ndarray, centre: np.ndarray, settings: Placement = Placement()) -> np.ndarray:
    """Return the point (3,) [m] of `cortex` (n, 3) nearest to `centre` (3,) that is accessible through the skull."""
    floor = min(cortex[:, 2].min() + settings.min_height * np.ptp(cortex[:, 2]), centre[2])
    return _find_outer_point(cortex[cortex[:, 2] >= floor], centre, cortex, settings)


def find_opening_at(cortex: np.ndarray, point: np.ndarray, settings: Placement = Placement()) -> np.ndarray:
    """Return the accessible point (3,) [m] of `cortex` (n, 3) nearest to a `point` (3,) at the surface.

    Raises
    ------
    InputError
        The point is not finite, is over the brainstem, or is more than `max_surface_distance` from accessible cortex.
    """
    _check_finite(point, "--opening-at")
    site = _find_outer_point(cortex, point, cortex, settings)
    apart = float(np.linalg.norm(site - point))
    if apart > settings.max_surface_distance:
        raise InputError(
            f"the opening at {_to_mm(point)} mm lies {apart * 1e3:.0f} mm from the nearest cortex that the skull "
            f"covers; {settings.max_surface_distance * 1e3:g} mm is the most. {_format_box(cortex)} Over a deep point, "
            "give --opening-over."
        )
    return _check_not_over_brainstem(cortex, site, settings)


def find_opening_over(
    cortex: np.ndarray, point: np.ndarray, depth: float, settings: Placement = Placement()
) -> np.ndarray:
    """Return the accessible point (3,) [m] of `cortex` (n, 3) nearest to a `point` (3,) in the brain, at `depth` [m].

    Raises
    ------
    InputError
        The point is not finite, is more than `max_outside_distance` outside the brain, or is over the brainstem.
    """
    _check_finite(point, "--opening-over")
    if not depth > -settings.max_outside_distance:
        raise InputError(
            f"the point {_to_mm(point)} mm lies {-depth * 1e3:.0f} mm outside the brain: give a point inside. "
            f"{_format_box(cortex)}"
        )
    return _check_not_over_brainstem(cortex, find_reachable_site(cortex, point, settings), settings)


def find_opening_within(cortex: np.ndarray, outline: np.ndarray, settings: Placement = Placement()) -> np.ndarray:
    """Return the accessible point (3,) [m] of `cortex` (n, 3) nearest to the centre of a craniotomy `outline` (m, 3).

    Raises
    ------
    InputError
        See `find_opening_at`; also if the outline is too far from the cortex.
    """
    apart = float(KDTree(cortex).query(outline)[0].max())
    if apart > settings.max_surface_distance:
        raise InputError(
            f"the opening's outline lies up to {apart * 1e3:.0f} mm from the cortex; "
            f"{settings.max_surface_distance * 1e3:g} mm is the most. {_format_box(cortex)} See that its coordinates "
            "are those of the labels."
        )
    inside = cortex[find_within_outline(cortex, outline)]
    return find_opening_at(cortex, inside.mean(axis=0) if len(inside) else outline.mean(axis=0), settings)


def find_within_outline(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of points (n, 3) inside a closed curve (m, 3), both projected onto its best-fit plane.

    Points farther from the plane than the radius of the curve are on the other side of the head and are excluded.
    """
    middle = outline.mean(axis=0)
    axes = np.linalg.svd(outline - middle, full_matrices=False)[2]
    corners, places = (outline - middle) @ axes[:2].T, (points - middle) @ axes.T
    near = np.flatnonzero((np.abs(places) <= np.linalg.norm(corners, axis=1).max()).all(axis=1))
    x, y = places[near, :1], places[near, 1:2]
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    crossed = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    found = np.zeros(len(points), bool)
    found[near] = (crossed & beyond).sum(axis=1) % 2 == 1
    return found


def _find_outer_point(points: np.ndarray, target: np.ndarray, cortex: np.ndarray, settings: Placement) -> np.ndarray:
    """Return the point nearest to `target` (3,) among those `points` (k, 3) that are near the hull of the `cortex`."""
    hull = ConvexHull(cortex).equations
    order = np.argsort(np.linalg.norm(points - target, axis=1), kind="stable")
    parts = (points[order[first : first + BLOCK_SIZE]] for first in range(0, len(order), BLOCK_SIZE))
    outer = (part[-(part @ hull[:, :3].T + hull[:, 3]).max(axis=1) <= settings.max_hull_depth] for part in parts)
    return next(part[0] for part in outer if len(part))


def _check_finite(point: np.ndarray, option: str) -> None:
    if not np.isfinite(point).all():
        raise InputError(f"{option} {_to_mm(point)}: every coordinate must be a finite number [mm].")


def _check_not_over_brainstem(cortex: np.ndarray, site: np.ndarray, settings: Placement) -> np.ndarray:
    lowest, height = cortex[cortex[:, 2].argmin()], np.ptp(cortex[:, 2])
    if np.linalg.norm(site - lowest) <= settings.brainstem_radius * height:
        raise InputError(
            f"the opening at {_to_mm(site)} mm lies over the brainstem, which is held: choose a point farther from the "
            f"brain's lowest one, {_to_mm(lowest)} mm."
        )
    return site


def _to_mm(point: np.ndarray) -> str:
    return ", ".join(f"{1e3 * value:.0f}" for value in point)


def _format_box(cortex: np.ndarray) -> str:
    low, high = _to_mm(cortex.min(axis=0)), _to_mm(cortex.max(axis=0))
    return f"The brain reaches from {low} to {high} mm (right, anterior, superior)."

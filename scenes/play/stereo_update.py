"""Observation of the open cortex from a stereo pair: points with correspondences in the scan, or a point cloud."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.outlines import compute_silhouette
from ar.stereo.disparity import (
    StereoCloud,
    StereoView,
    compute_stereo_view,
    find_consistent_motions,
    track_pixels,
    triangulate_cloud,
)
from ar.stereo.rectified import build_rectification
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from surrogate.locating.evidence import NOISE, SIGMA
from surrogate.locating.observation import Observation

from ..script.craniotomy_frame import HOLE_RATIO, CraniotomyFrame


@dataclass(frozen=True)
class StereoUpdateSettings:
    """Settings of `observe_first_pair`, `observe_points` and `observe_point_cloud`."""

    resolution: float = 6000.0  # Resolution of the rectified images [pixel/m of cortex].
    half_width_ratio: float = 1.05  # Half-width of the rectified images [radii of the craniotomy].
    # Minimum distance of points from the drape [m]: it is above the cortex, and its disparity differs.
    min_drape_distance: float = 1.5e-3
    # Largest median distance of the first pair's points from the scan's cortex [m]: beyond, the calibration is of other
    # cameras.
    max_cortex_distance: float = 2.5e-3
    max_motion: float = 10e-3  # Search range of motions [m]; if half of them seem larger, eyes were swapped.
    min_found_share: float = 0.3  # Smallest share of the points that must be found again.
    # Maximum number of points in the static surroundings of the craniotomy that are examined.
    max_static_points: int = 60
    min_static_points: int = 15  # Minimum number of points found in the static surroundings.
    # Motion within which a quarter of the surroundings must stay [m]; the others are at the edge of the drape.
    static_tolerance: float = 2e-3


STEREO = StereoUpdateSettings()
LARGE_MOTION_HINT = (
    f" Or the cortex has moved by about {1e3 * STEREO.max_motion:g} mm or more since the first pair, farther than "
    "it is searched for: begin with a new scan."
)
"""Part of an error message: a reason why points of the first pair are not found in a later pair."""
Rigid = Callable[[np.ndarray], np.ndarray]
"""Function that adds the tracking error of a microscope to positions (n, 3) [m]."""


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Stereo pair of a microscope.

    Parameters
    ----------
    cameras, images
        Cameras of the left and the right eye; images (H, W, 3) uint8.
    tool
        Surface of the tracked tool in view: corners (t, 3) [m] and faces (f, 3); None without tool.
    """

    cameras: tuple[Camera, Camera]
    images: tuple[np.ndarray, np.ndarray]
    tool: tuple[np.ndarray, np.ndarray] | None = None

    def rectify(self, site: CraniotomyFrame) -> StereoView:
        """Rectify the pair; both rectified images are centred on the craniotomy.

        Raises
        ------
        InputError
            Swapped cameras, or a camera that does not see the craniotomy.
        """
        masks = None if self.tool is None else tuple(compute_silhouette(camera, *self.tool) for camera in self.cameras)
        target = cast(tuple[float, float, float], tuple(site.origin.tolist()))
        try:
            geometry = build_rectification(
                *self.cameras, target, STEREO.half_width_ratio * site.radius, STEREO.resolution
            )
            return compute_stereo_view(geometry, *self.images, cast(tuple[np.ndarray, np.ndarray] | None, masks))
        except ValueError as error:
            raise InputError(str(error)) from error


@dataclass(frozen=True, eq=False)
class FirstView:
    """First image pair, with points that later pairs are compared with.

    Parameters
    ----------
    stereo_view
        Rectified view of the pair.
    pixels, rest_positions
        Pixels (n, 2) of cortex points, and their positions (n, 3) [m] in the scan; n <= `requested_count`.
    static_pixels, static_positions
        Pixels (m, 2) of static points around the craniotomy, and their positions (m, 3) [m].
    """

    stereo_view: StereoView
    pixels: np.ndarray
    rest_positions: np.ndarray
    requested_count: int
    static_pixels: np.ndarray
    static_positions: np.ndarray


def observe_first_pair(site: CraniotomyFrame, pair: StereoPair, count: int, add_rigid_error: Rigid) -> FirstView:
    """Match about `count` points of the first pair, which shows the undeformed brain, with the scan's nearest points.

    Raises
    ------
    InputError
        See `StereoPair.rectify`; also if too few points are found, or if they are too far from the scan's cortex.
    """
    view = pair.rectify(site)
    pixels = build_pixel_grid(site, view, count)
    found = triangulate_pixels(site, view, pixels)
    points = add_rigid_error(found.points)
    rest, off = find_nearest_on_cortex(site, points)
    if len(off) and np.median(off) > STEREO.max_cortex_distance:
        raise InputError(
            f"the first image pair shows a cortex {1e3 * np.median(off):.1f} mm from the scan's: check that eyes "
            "are not swapped, or calibrate them again."
        )
    good = find_consistent_motions(rest, points - rest)
    require_points(int(good.sum()), len(pixels))
    around, still = find_static_points(site, view)
    return FirstView(view, pixels[found.indices[good]], rest[good], len(pixels), around, add_rigid_error(still))


def observe_points(
    site: CraniotomyFrame, first_view: FirstView, pair: StereoPair, add_rigid_error: Rigid, contact_points: np.ndarray
) -> Observation:
    """Observe the points of the first pair in a later pair; a tool touches the cortex at `contact_points` (k, 3) [m].

    Raises
    ------
    InputError
        See `StereoPair.rectify`; too few points; moving surroundings; motions larger than the search range.
    """
    view = pair.rectify(site)
    check_surroundings_static(first_view, view, add_rigid_error)
    which, there = track_pixels(first_view.stereo_view, view, first_view.pixels)
    found = triangulate_pixels(site, view, there)
    now, rest = add_rigid_error(found.points), first_view.rest_positions[which[found.indices]]
    good = find_consistent_motions(rest, now - rest)
    require_points(int(good.sum()), first_view.requested_count, LARGE_MOTION_HINT)
    motion = float(np.median(np.linalg.norm(now - rest, axis=1)))
    if motion > STEREO.max_motion:
        raise InputError(
            f"half of the points seem to have moved by {1e3 * motion:.0f} mm, farther than they are searched for: "
            "check that eyes are not swapped, or begin with a new scan."
        )
    return Observation(now[good], rest[good], scale_deviations(found.sigma[good]), add_rigid_error(contact_points))


def observe_point_cloud(
    site: CraniotomyFrame, pair: StereoPair, count: int, add_rigid_error: Rigid, contact_points: np.ndarray
) -> Observation:
    """Observe about `count` cortex points without correspondences, from one pair.

    For the other arguments and the errors see `observe_points`.
    """
    view = pair.rectify(site)
    pixels = build_pixel_grid(site, view, count)
    found = triangulate_pixels(site, view, pixels)
    points = add_rigid_error(found.points)
    rest, _ = find_nearest_on_cortex(site, points)
    good = find_consistent_motions(rest, points - rest)
    require_points(int(good.sum()), len(pixels))
    return Observation(points[good], None, scale_deviations(found.sigma[good]), add_rigid_error(contact_points))


def build_pixel_grid(site: CraniotomyFrame, view: StereoView, count: int) -> np.ndarray:
    """Build a regular grid of about `count` pixels (n, 2) of the left rectified image, inside the drape's hole."""
    reach = HOLE_RATIO * site.clearance - STEREO.min_drape_distance
    step = reach * np.sqrt(np.pi / count)
    ticks = np.arange(-np.floor(reach / step), np.floor(reach / step) + 1) * step
    x, y = (each.ravel() for each in np.meshgrid(ticks, ticks))
    inside = np.hypot(x, y) < reach
    places = site.origin + x[inside, None] * site.right + y[inside, None] * site.up
    return view.geometry.project_points(places)[0]


def triangulate_pixels(site: CraniotomyFrame, view: StereoView, pixels: np.ndarray) -> StereoCloud:
    """Triangulate pixels (n, 2) of the left rectified image; return the points inside the drape's hole.

    Raises
    ------
    InputError
        The image rows of the two eyes do not match.
    """
    try:
        found = triangulate_cloud(view, pixels)
    except ValueError as error:
        raise InputError(str(error)) from error
    inside = site.compute_axis_distance(found.points) < HOLE_RATIO * site.clearance - STEREO.min_drape_distance
    return StereoCloud(found.indices[inside], found.points[inside], found.sigma[inside])


def find_static_points(site: CraniotomyFrame, view: StereoView) -> tuple[np.ndarray, np.ndarray]:
    """Return left pixels (m, 2) that show points around the craniotomy, and the positions (m, 3) [m] of the points."""
    ticks = np.linspace(0.0, view.geometry.size - 1.0, 40)
    pixels = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    found = triangulate_cloud(view, pixels)
    outside = np.flatnonzero(site.compute_axis_distance(found.points) > HOLE_RATIO * site.clearance)
    some = outside[np.linspace(0, len(outside) - 1, min(STEREO.max_static_points, len(outside))).astype(int)]
    return pixels[found.indices[some]], found.points[some]


def check_surroundings_static(first_view: FirstView, view: StereoView, add_rigid_error: Rigid) -> None:
    """Raise InputError if the surroundings of the craniotomy seem to have moved since the first pair."""
    which, there = track_pixels(first_view.stereo_view, view, first_view.static_pixels)
    try:
        found = triangulate_cloud(view, there)
    except ValueError as error:
        raise InputError(str(error)) from error
    if len(found.indices) < STEREO.min_static_points:
        return
    motion = np.linalg.norm(add_rigid_error(found.points) - first_view.static_positions[which[found.indices]], axis=1)
    moved = float(np.quantile(motion, 0.25))
    if moved > STEREO.static_tolerance:
        raise InputError(
            f"what lies round the opening seems to have moved by {1e3 * moved:.1f} mm: check that eyes are not "
            "swapped, and calibrate and track the microscope again."
        )


def find_nearest_on_cortex(site: CraniotomyFrame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the scan's cortex points (n, 3) [m] that are nearest to `points` (n, 3) [m], and distances (n,) [m]."""
    if not len(points):
        return points, np.zeros(0)
    anatomy = site.anatomy
    place = find_closest_points(points, anatomy.mesh.nodes[anatomy.open_surface]).point
    return place, np.linalg.norm(points - place, axis=1)


def scale_deviations(sigma: np.ndarray) -> np.ndarray:
    """Scale standard deviations (n,) [m] of independent noise to `sigma` of a locator, which adds correlated noise."""
    return sigma * (SIGMA / NOISE.independent_error)


def require_points(count: int, requested: int, other_reason: str = "") -> None:
    """Raise InputError if `count` is too small a share of the `requested` points; `other_reason` joins the message."""
    if count < STEREO.min_found_share * requested:
        raise InputError(
            f"both eyes see {count} of {requested} places of the cortex surely: check light, focus and texture, and "
            f"what hides it.{other_reason}"
        )

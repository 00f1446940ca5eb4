"""Framing: direction, target and field of view from which a camera sees the tumour through the craniotomy."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from ar.optics.camera import Camera, look_at
from sim.geometry.closest_point import find_closest_points

from .craniotomy_frame import HOLE_RATIO, CraniotomyFrame

DRAPE_HEIGHT = 3.0e-3  # Height of the drape above the brain [m].
BAND_MARGIN = 8e-3  # Width of the error band that is kept inside the image [m].
MIN_VISIBLE = 0.95  # Share of the tumour's outline that should lie inside the craniotomy.
MAX_TILT = 0.8  # Largest tilt [rad]: an oblique view shows motion along the axis of the craniotomy.
TILTS = np.linspace(MAX_TILT, 0.0, 17)  # Tilts that are tried [rad].
TURNS = np.radians([0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 90.0, -90.0, 120.0, -120.0, 150.0, -150.0])
"""Candidate azimuths of the tilt about the axis [rad]; 0: towards the lower edge of the image."""
FILLED = 0.94  # Share of the image that the framed points fill.
MIN_FIELD = 45e-3  # Smallest height of the field of view [m]: a tool must be recognised.
RIM_COUNT = 48  # Number of points on the edge of the craniotomy.
OUTLINE_COUNT = 96  # Number of points on the outline.
FIELD = np.radians(16.0)  # Vertical field of view while directions are compared [rad].


@dataclass(frozen=True, eq=False)
class Framing:
    """View of a camera: direction (3,) from target to camera, target (3,) [m], and vertical field of view [rad].

    `visible_share` is the share of the undeformed tumour's outline that the camera sees inside the craniotomy.
    """

    direction: np.ndarray
    target: np.ndarray
    fov: float
    visible_share: float


@lru_cache(maxsize=8)
def find_framing(
    site: CraniotomyFrame, distance: float, aspect_ratio: float, direction: tuple[float, float] | None = None
) -> Framing:
    """Find the most oblique view in which the tumour's outline is inside the craniotomy.

    If there is no such view, the view with the largest share of the outline is used. The image contains the
    craniotomy, the outline and its error band.

    Parameters
    ----------
    distance
        Distance of the camera from the target [m].
    aspect_ratio
        Width of the image over its height.
    direction
        Tilt from the outward normal and azimuth about the axis [rad]; None: the best candidate.
    """
    anatomy = site.anatomy
    surface = anatomy.mesh.nodes[np.unique(anatomy.tumour_surface)]
    rims = build_hole_edges(site)
    if direction is None:
        views = [(tilt, turn) for tilt in TILTS for turn in TURNS]
        # A view from the lower edge shows the tool from its side.
        views.sort(key=lambda view: -view[0] * np.cos(0.5 * view[1]))
    else:
        views = [direction]
    best = -1.0, views[0]
    for tilt, turn in views:
        outward = compute_view_direction(site, tilt, turn)
        camera = look_at(site.origin + distance * outward, site.origin, site.up, FIELD, 640, 480)
        share = compute_visible_share(camera, surface, rims)
        if share > best[0]:
            best = share, (tilt, turn)
        if share >= MIN_VISIBLE:
            break
    centre = surface.mean(axis=0)
    arm = surface - centre
    band = surface + BAND_MARGIN * arm / np.linalg.norm(arm, axis=1, keepdims=True)
    outward = compute_view_direction(site, *best[1])
    target, fov = fit_field_of_view(np.vstack([rims[0], band]), site, outward, distance, aspect_ratio)
    return Framing(outward, target, fov, best[0])


def compute_view_direction(site: CraniotomyFrame, tilt: float, azimuth: float = 0.0) -> np.ndarray:
    """Return the unit direction (3,) to a camera with tilt [rad] from the outward normal; azimuth 0 [rad] is `-up`."""
    aside = np.cos(azimuth) * site.up + np.sin(azimuth) * site.right
    return -np.cos(tilt) * site.axis - np.sin(tilt) * aside


def build_hole_edges(site: CraniotomyFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return two edges (n, 3) [m] of the drape's hole: the edge on the drape, and the points of the cortex below."""
    angle = np.linspace(0.0, 2.0 * np.pi, RIM_COUNT, endpoint=False)
    circle = np.outer(np.cos(angle), site.right) + np.outer(np.sin(angle), site.up)
    flat = site.origin + HOLE_RATIO * site.clearance * circle
    found = find_closest_points(flat, site.corners).point
    cortex = flat + ((found - flat) @ site.axis)[:, None] * site.axis
    return cortex - DRAPE_HEIGHT * site.axis, cortex


def compute_visible_share(camera: Camera, surface: np.ndarray, hole_edges: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the share of the outline of a surface (n, 3) [m] that a camera sees inside the edges of the hole."""
    hull = _find_hull(camera.project(surface)[0])
    steps = np.linalg.norm(np.roll(hull, -1, axis=0) - hull, axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, along[-1], OUTLINE_COUNT, endpoint=False)
    closed = np.vstack([hull, hull[:1]])
    outline = np.stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)], axis=1)
    inside = np.ones(OUTLINE_COUNT, bool)
    for rim in hole_edges:
        polygon = _find_hull(camera.project(rim)[0])
        edge = np.roll(polygon, -1, axis=0) - polygon
        arm = outline[:, None] - polygon
        side = edge[:, 0] * arm[..., 1] - edge[:, 1] * arm[..., 0]
        inside &= (side >= 0.0).all(axis=1) | (side <= 0.0).all(axis=1)
    return float(inside.mean())


def _find_hull(points: np.ndarray) -> np.ndarray:
    return points[ConvexHull(points).vertices]


def fit_field_of_view(
    points: np.ndarray, site: CraniotomyFrame, view_direction: np.ndarray, distance: float, aspect_ratio: float
) -> tuple[np.ndarray, float]:
    """Return target (3,) [m] and vertical field of view [rad] of a camera whose image just contains points (n, 3) [m].

    The camera is at `distance` [m] from the target, in the unit direction `view_direction` (3,).
    """
    target, half = points.mean(axis=0), 0.1
    for _ in range(4):
        camera = look_at(target + distance * view_direction, target, site.up)
        seen = camera.to_camera_frame(points)
        slope = seen[:, :2] / seen[:, 2:]
        low, high = slope.min(axis=0), slope.max(axis=0)
        x, y = 0.5 * distance * (low + high)
        target = target + x * camera.T_camera_world[0, :3] + y * camera.T_camera_world[1, :3]
        half = float(max((high - low)[1], (high - low)[0] / aspect_ratio)) / (2.0 * FILLED)
    return target, 2.0 * float(np.arctan(max(half, 0.5 * MIN_FIELD / distance)))

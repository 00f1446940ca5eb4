"""Entry point and direction of a planned trajectory, which the tool of a scene follows."""

from dataclasses import dataclass, replace

import numpy as np

from sim.bodies.markups import Markup
from sim.errors import InputError

from .craniotomy_frame import CraniotomyFrame
from .tool import Instrument, Probe
from .tool_paths import Path, Touch

# Largest angle to the craniotomy's axis [rad]: a tool that enters more obliquely slides along the cortex.
MAX_ENTRY_ANGLE = np.radians(60.0)
# Largest distance of a point from the open cortex, and largest extension of a line that is to reach it [m].
MAX_CORTEX_DISTANCE = 10e-3
ITERATIONS = 6  # Number of iterations from a point in the tangent plane to one of the curved cortex.


@dataclass(frozen=True)
class Approach:
    """Entry point (x, y) [m] of a tool in the tangent plane, and tilt [rad] of the tool path, both as in `Touch`.

    If `along_line` is True, the shaft of the tool is aligned with the trajectory.
    """

    x: float
    y: float
    tilt: tuple[float, float] = (0.0, 0.0)
    along_line: bool = False

    def shift_path(self, path: Path) -> Path:
        """Return a tool path moved from the centre of the craniotomy to the entry point, with the approach's tilt."""

        def get_touch(time: float) -> Touch:
            touch = path(time)
            right, up = (float(np.arctan(np.tan(a) + np.tan(b))) for a, b in zip(self.tilt, touch.tilt, strict=True))
            return replace(touch, x=self.x + touch.x, y=self.y + touch.y, tilt=(right, up))

        return get_touch

    def align_tool(self, tool: Instrument) -> Instrument:
        """Return the tool with its shaft along the trajectory, if `along_line`.

        Any tool other than a `Probe` keeps its orientation, because its contact depends on the orientation.
        """
        if not (self.along_line and isinstance(tool, Probe)):
            return tool
        right, up = -np.tan(self.tilt)
        return replace(tool, lean=float(np.arctan(np.hypot(right, up))), turn=float(np.arctan2(up, right)))


def parse_approach(markup: Markup, site: CraniotomyFrame) -> Approach:
    """Compute the approach from a markup: a line, or a point that the tool approaches along the craniotomy's axis.

    Raises
    ------
    InputError
        Another kind of markup; a line that misses the open cortex, is too oblique, or ends too far from the cortex; a
        point too far from the cortex.
    """
    points, path = markup.points, markup.path
    if markup.kind == "Fiducial" and len(points) == 1:
        entry = site.find_nearest(points[0]).point
        apart = float(np.linalg.norm(entry - points[0]))
        if apart > MAX_CORTEX_DISTANCE:
            raise InputError(
                f"{path}: its point lies {1e3 * apart:.0f} mm from the open cortex, and "
                f"{1e3 * MAX_CORTEX_DISTANCE:g} mm is the most. "
                "Open the skull there (--opening-at), or mark another entry."
            )
        return _compute_approach(site, entry, site.axis)
    if markup.kind != "Line" or len(points) != 2 or not np.ptp(points, axis=0).any():
        raise InputError(f"{path}: is no trajectory. Save a line of two points, or one point, from 3D Slicer.")
    outer, deep = sorted(points, key=lambda point: float((point - site.origin) @ site.axis))
    way = (deep - outer) / np.linalg.norm(deep - outer)
    angle = float(np.arccos(np.clip(way @ site.axis, -1.0, 1.0)))
    if angle > MAX_ENTRY_ANGLE:
        raise InputError(
            f"{path}: runs at {np.degrees(angle):.0f} degrees to the opening's axis, and "
            f"{np.degrees(MAX_ENTRY_ANGLE):.0f} is "
            "the most. Open the skull where it enters: --opening-at with this file."
        )
    entry = _find_entry(site.corners, outer, way)
    if entry is None:
        arm = site.corners.reshape(-1, 3) - outer
        beside = float(np.linalg.norm(arm - np.outer(arm @ way, way), axis=1).min())
        raise InputError(
            f"{path}: passes {1e3 * beside:.0f} mm from the open cortex. Open the skull where it enters: "
            "--opening-at with this file."
        )
    before, beyond = float((outer - entry) @ way), float((entry - deep) @ way)
    apart = max(before, beyond)
    if apart > MAX_CORTEX_DISTANCE:
        raise InputError(
            f"{path}: ends {1e3 * apart:.0f} mm from where it would enter the open cortex, and "
            f"{1e3 * MAX_CORTEX_DISTANCE:g} mm is "
            "the most that a line is drawn out by. See that it is of this opening, and draw it through the cortex."
        )
    return replace(_compute_approach(site, entry, way), along_line=True)


def _compute_approach(site: CraniotomyFrame, entry: np.ndarray, direction: np.ndarray) -> Approach:
    """Compute the approach with an entry point (3,) [m] on the cortex and a direction (3,)."""
    axes = np.stack([site.right, site.up])
    place = axes @ (entry - site.origin)
    for _ in range(ITERATIONS):
        place = place + axes @ (entry - site.find_nearest(site.origin + place @ axes).point)
    right, up = np.arctan(axes @ direction / (direction @ site.axis)).tolist()
    return Approach(float(place[0]), float(place[1]), (right, up))


def _find_entry(corners: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Compute the first intersection (3,) [m] of a line with triangles (S, 3, 3) [m]; None if there is no intersection.

    Möller, Trumbore 1997, J. Graphics Tools 2:21-28.
    """
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across, arm = np.cross(direction, second), start - corners[:, 0]
    turned = np.cross(arm, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.einsum("si,si->s", first, across)
        u, v = scale * np.einsum("si,si->s", arm, across), scale * (turned @ direction)
        far = scale * np.einsum("si,si->s", second, turned)
    met = np.isfinite(scale) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return start + far[met].min() * direction if met.any() else None

"""Gauge of the distance between a tool's tip and the hidden surface: a line, and a number next to the tip."""

from dataclasses import dataclass

import cv2
import numpy as np

from ..optics.camera import Camera
from .hud import Hideable, format_millimetres, place_text
from .outlines import OPAQUE

NUMBER_SCALE = 0.6  # Font scale of the number at the tip.
NUMBER_DISTANCE = 10  # Horizontal and vertical distance of the number from the tip [pixel].
LINE_POINTS = 33  # Number of points of the line, which is curved under lens distortion.


@dataclass(frozen=True, eq=False)
class DistanceGauge:
    """Distance between the tool's tip and the hidden surface.

    Parameters
    ----------
    tip, nearest_point
        World points (3,) [m]: the tool's tip, and the closest point of the hidden surface.
    reading
        Distance [m], if known more accurately than the distance between the two points; None: that distance.
    error
        Error bound [m] of the distance; None if not available.
    is_inside
        True if the tip is inside the hidden surface.
    """

    tip: np.ndarray
    nearest_point: np.ndarray
    reading: float | None = None
    error: float | None = None
    is_inside: bool = False

    @property
    def distance(self) -> float:
        """Distance [m]: `reading` if given, else between tip and nearest point."""
        return (
            float(np.linalg.norm(np.asarray(self.tip) - self.nearest_point)) if self.reading is None else self.reading
        )

    def __str__(self) -> str:
        """Return the text shown next to the tip."""
        return format_tip_distance(self.distance, self.error, self.is_inside)


def format_tip_distance(distance: float, error: float | None, is_inside: bool) -> str:
    """Format the distance [m] of a tip from a surface, with its error bound [m] if given, as text."""
    length = format_millimetres(distance, error)
    return f"inside, {length} from its edge" if is_inside else length


def draw_gauge_line(canvas: np.ndarray, camera: Camera, gauge: DistanceGauge) -> None:
    """Draw the gauge's line in place; nothing if a part of the line is not projected by the camera."""
    # Lens distortion bends the line.
    shares = np.linspace(0.0, 1.0, 2 if camera.lens is None else LINE_POINTS)[:, None]
    line, _ = camera.project((1.0 - shares) * gauge.tip + shares * gauge.nearest_point)
    if not np.isfinite(line).all():
        return
    line = np.clip(line, -1e4, 1e4).round().astype(np.int32)[:, None]
    cv2.polylines(canvas, [line], False, (12, 14, 16, OPAQUE), 3, cv2.LINE_AA)
    cv2.polylines(canvas, [line], False, (250, 250, 250, OPAQUE), 1, cv2.LINE_AA)
    cv2.circle(canvas, line[-1, 0].tolist(), 3, (250, 250, 250, OPAQUE), -1, cv2.LINE_AA)


def write_distance(
    image: np.ndarray, occupied: np.ndarray, camera: Camera, gauge: DistanceGauge, tool_mask: np.ndarray,
    lines: np.ndarray, ring_lines: np.ndarray,
) -> None:  # fmt: skip
    """Write the gauge's number next to the tip, in place; nothing if neither end of its line is projected.

    The number is always inside the image; without free space it covers other lines.

    Parameters
    ----------
    image, occupied
        Image (H, W, 3) uint8, and mask (H, W) uint8 of lines and text.
    lines, ring_lines
        See `Hideable`.
    tool_mask
        Mask (H, W) uint8 of tools, which the number covers only if there is no other space.
    """
    ends, _ = camera.project(np.stack([gauge.tip, gauge.nearest_point]))
    seen = ends[np.isfinite(ends).all(axis=1)]
    if len(seen):
        column, row = np.clip(seen[0], -1e4, 1e4).round().astype(int).tolist()
        wish = column + NUMBER_DISTANCE, row + NUMBER_DISTANCE
        place_text(
            image, occupied, [str(gauge)], wish, NUMBER_SCALE, force=True, parts=Hideable(tool_mask, lines, ring_lines)
        )

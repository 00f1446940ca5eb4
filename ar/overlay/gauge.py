"""How far a tool is from a hidden surface: a line, and the number beside the tip."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..optics.camera import Camera
from .hud import Below, lay, millimetres
from .outlines import OPAQUE

# Scale of the number, and how far from the tip it is wanted [pixel].
GAUGE, BESIDE = 0.6, 10
# Points of a straight line that a lens bends.
BENDS = 33


@dataclass(frozen=True, eq=False)
class Gauge:
    """The number asked for first: how far the tool is from the hidden surface.

    Parameters
    ----------
    tip, nearest
        (3,) [m] world points: the tool's tip and the point of the hidden surface that is nearest to it.
    read
        The distance [m], where it is known better than by the line between the two.
    error
        How far off the number may be [m]; None where nobody knows.
    inside
        Whether the tip is within the hidden surface.
    """

    tip: np.ndarray
    nearest: np.ndarray
    read: float | None = None
    error: float | None = None
    inside: bool = False

    @property
    def distance(self) -> float:
        """[m]."""
        return float(np.linalg.norm(np.asarray(self.tip) - self.nearest)) if self.read is None else self.read

    def __str__(self) -> str:
        """As it is printed beside the tip."""
        return gauge_words(self.distance, self.error, self.inside)


def gauge_words(distance: float, error: float | None, inside: bool) -> str:
    """How far [m] a tip is from a surface, in words, and how far off [m] that may be."""
    length = millimetres(distance, error)
    return f"inside, {length} from its edge" if inside else length


def draw_line(sheet: np.ndarray, camera: Camera, gauge: Gauge) -> None:
    """Draw the gauge's line, in place; nothing when a part of it lies behind the camera or beyond its lens."""
    # A lens bends it.
    shares = np.linspace(0.0, 1.0, 2 if camera.lens is None else BENDS)[:, None]
    line, _ = camera.project((1.0 - shares) * gauge.tip + shares * gauge.nearest)
    if not np.isfinite(line).all():
        return
    line = np.clip(line, -1e4, 1e4).round().astype(np.int32)[:, None]
    cv2.polylines(sheet, [line], False, (12, 14, 16, OPAQUE), 3, cv2.LINE_AA)
    cv2.polylines(sheet, [line], False, (250, 250, 250, OPAQUE), 1, cv2.LINE_AA)
    cv2.circle(sheet, line[-1, 0].tolist(), 3, (250, 250, 250, OPAQUE), -1, cv2.LINE_AA)


def write_gauge(
    colour: np.ndarray,
    taken: np.ndarray,
    camera: Camera,
    gauge: Gauge,
    covered: np.ndarray,
    lines: np.ndarray,
    thin: np.ndarray,
) -> None:
    """Write the gauge's number beside the tip, in place; nothing when neither end of its line has a pixel.

    It stands inside the picture, even over other lines where there is no space.

    Parameters
    ----------
    colour, taken, lines, thin
        As `lay` takes them; the third as its `lines_there`.
    covered
        (H, W) uint8: above 0 where tools are, which the number leaves in sight if it can.
    """
    ends, _ = camera.project(np.stack([gauge.tip, gauge.nearest]))
    seen = ends[np.isfinite(ends).all(axis=1)]
    if len(seen):
        column, row = np.clip(seen[0], -1e4, 1e4).round().astype(int).tolist()
        wish = column + BESIDE, row + BESIDE
        lay(colour, taken, [str(gauge)], wish, GAUGE, needed=True, below=Below(covered, lines, thin))

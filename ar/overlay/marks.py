"""Arguments of `composite`: marks and words beside a hidden surface, and the cover over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.layer import Layer
from .gauge import Gauge
from .legend import Names
from .outlines import OPAQUE, blank, box_around, dash, ink_of, outlines, silhouette
from .styles import Opening
from .window import DARK

# What was believed before is drawn in grey, and dotted: lengths of strokes and gaps [pixel].
BEFORE, DOTTED = (0.86, 0.88, 0.90), (2, 5)
# A motion of fewer pixels has no arrow.
LEAST_ARROW = 4.0
UNNAMED = Names()


@dataclass(frozen=True, eq=False)
class Trace:
    """The outline of another surface, in its layer's colour: strokes and gaps of so many pixels, and a dot at a point.

    The point is `dot` (3,) [m].
    """

    layer: Layer
    pattern: tuple[int, int]
    dot: np.ndarray


def draw_before(sheet: np.ndarray, camera: Camera, box: tuple[slice, slice], before: Layer, hidden: Layer) -> None:
    """Draw where the hidden surface was, dotted, and an arrow from its middle there to its middle now, in place.

    The sheet is that of the picture's rows and columns `box`, which hold both surfaces.
    """
    there = box_around(camera, before.vertices)
    if there is not None:
        rows, columns = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(there, box, strict=True))
        sheet[rows, columns] = dotted(camera, before)
    middles = np.stack([before.vertices.mean(axis=0), hidden.vertices.mean(axis=0)])
    ends, _ = camera.cropped(*box).project(middles)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length >= LEAST_ARROW:  # nor where one has no pixel
        return
    start, end = (tuple(each) for each in np.clip(ends, -1e4, 1e4).round().astype(int).tolist())
    for ink, width in ((DARK, 4), (ink_of(BEFORE), 2)):
        cv2.arrowedLine(sheet, start, end, (*ink, OPAQUE), width, cv2.LINE_AA, tipLength=min(0.5, 6.0 / length))


@lru_cache(maxsize=4)
def dotted(camera: Camera, layer: Layer) -> np.ndarray:
    """The dotted outline of a layer that stays, on the sheet of the box around it: drawn once for a camera."""
    box = box_around(camera, layer.vertices)
    assert box is not None
    part = camera.cropped(*box)
    sheet = blank(part)
    dash(sheet, outlines(silhouette(part, layer.vertices, layer.triangles)), ink_of(BEFORE), DOTTED)
    return sheet


def draw_trace(sheet: np.ndarray, camera: Camera, trace: Trace) -> None:
    """Draw a trace, in place; nothing when its dot lies behind the camera or beyond its lens."""
    (at,), _ = camera.project(np.asarray(trace.dot)[None])
    if not np.isfinite(at).all():
        return
    ink = ink_of(trace.layer.colour)
    dash(sheet, outlines(silhouette(camera, trace.layer.vertices, trace.layer.triangles)), ink, trace.pattern)
    column, row = np.clip(at, -1e4, 1e4).round().astype(int).tolist()
    pale = [0.5 * (share + 255.0) for share in ink]  # so that pixels of the ink are the outline's alone
    for colour, radius in ((DARK, 4), (pale, 3)):
        cv2.circle(sheet, (column, row), radius, (*colour, OPAQUE), -1, cv2.LINE_AA)


@dataclass(frozen=True, eq=False)
class Cover:
    """Layers and ground over the hidden surface.

    Parameters
    ----------
    occluders
        Ids of the layers (tool, hand) that cover the overlay wherever the picture shows them.
    opening
        The ground that the surface may be seen through; None: any. Under other ground the outline is broken, nothing
        shines through, and the picture says what it lies under where that is a noticeable share.
    covered
        (H, W) bool: what covers the overlay besides the occluders, as a hand or cottonoids in a real picture.
    """

    occluders: Sequence[int] = ()
    opening: Opening | None = None
    covered: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Marks:
    """Lines that are drawn beside the hidden surface's outline.

    Parameters
    ----------
    margin
        One number or (V,) [m]: how uncertain the surface is. Where positive, a dashed second outline runs that far out.
    gauge
        Draws the line from the tip to the hidden surface, and its length in millimetres beside the tip.
    before
        Where the hidden surface was before, as in the scan: a dotted grey outline, with an arrow from there to here and
        the mean motion in millimetres.
    traces
        Outlines of other surfaces, drawn under the hidden one's.
    """

    margin: float | np.ndarray = 0.0
    gauge: Gauge | None = None
    before: Layer | None = None
    traces: Sequence[Trace] = ()


@dataclass(frozen=True, eq=False)
class Words:
    """Words in the picture.

    Parameters
    ----------
    doubt
        Why the surface's place may not be relied on. It is written at the picture's foot, see `doubt_lines`, whatever
        the style. The outline is amber and broken. Nothing is promised: no margin is drawn, and the number beside the
        tip has no error.
    head
        Lines that are written at the picture's head, whatever the style and whatever lies there.
    names
        What the lines are called in the legend, which is drawn where there is room.
    moved
        Length and error [m] to be written in place of the mean motion, which has none.
    error
        How far off the surface may be [m], for the words of the styles that measure; None where it is not known.
    """

    doubt: str = ""
    head: Sequence[str] = ()
    names: Names = UNNAMED
    moved: tuple[float, float] | None = None
    error: float | None = None


NO_COVER, NO_MARKS, NO_WORDS = Cover(), Marks(), Words()

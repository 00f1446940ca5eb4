"""Arguments of `composite`: lines and text in addition to a hidden surface, and the cover over it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.layer import Layer
from .gauge import Gauge
from .legend import LegendNames
from .outlines import (
    OPAQUE,
    allocate_sheet,
    compute_ink,
    compute_silhouette,
    draw_dashes,
    find_outlines,
    find_pixel_box,
)
from .styles import Opening
from .window import BORDER_COLOUR

BEFORE_COLOUR = (0.86, 0.88, 0.90)  # Colour of the previous position (RGB, 0 to 1): grey.
BEFORE_STROKES = (2, 5)  # Stroke and gap lengths of the outline at the previous position [pixel].
MIN_ARROW = 4.0  # Smallest motion with an arrow [pixel].
DEFAULT_NAMES = LegendNames()  # Default legend names.


@dataclass(frozen=True, eq=False)
class Trace:
    """Outline of another surface in its layer's colour: a pattern of strokes and gaps [pixel], and a dot.

    The dot is at `dot` (3,) [m].
    """

    layer: Layer
    pattern: tuple[int, int]
    dot: np.ndarray


def draw_before(sheet: np.ndarray, camera: Camera, box: tuple[slice, slice], before: Layer, hidden: Layer) -> None:
    """Draw the dotted earlier outline of the hidden surface, and an arrow from its earlier to its present centroid.

    In place, on the sheet of the image's rows and columns `box`, which hold both surfaces.
    """
    there = find_pixel_box(camera, before.vertices)
    if there is not None:
        rows, columns = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(there, box, strict=True))
        sheet[rows, columns] = draw_dotted(camera, before)
    middles = np.stack([before.vertices.mean(axis=0), hidden.vertices.mean(axis=0)])
    ends, _ = camera.crop_to(*box).project(middles)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length >= MIN_ARROW:  # also true for NaN: an end without a pixel
        return
    start, end = (tuple(each) for each in np.clip(ends, -1e4, 1e4).round().astype(int).tolist())
    for ink, width in ((BORDER_COLOUR, 4), (compute_ink(BEFORE_COLOUR), 2)):
        cv2.arrowedLine(sheet, start, end, (*ink, OPAQUE), width, cv2.LINE_AA, tipLength=min(0.5, 6.0 / length))


@lru_cache(maxsize=4)
def draw_dotted(camera: Camera, layer: Layer) -> np.ndarray:
    """Draw the dotted outline of a fixed layer, on the sheet of the box around it; cached for a camera."""
    box = find_pixel_box(camera, layer.vertices)
    assert box is not None
    part = camera.crop_to(*box)
    sheet = allocate_sheet(part)
    draw_dashes(
        sheet,
        find_outlines(compute_silhouette(part, layer.vertices, layer.triangles)),
        compute_ink(BEFORE_COLOUR),
        BEFORE_STROKES,
    )
    return sheet


def draw_trace(sheet: np.ndarray, camera: Camera, trace: Trace) -> None:
    """Draw a trace, in place; nothing if its dot is behind the camera or beyond its lens."""
    (at,), _ = camera.project(np.asarray(trace.dot)[None])
    if not np.isfinite(at).all():
        return
    ink = compute_ink(trace.layer.colour)
    draw_dashes(
        sheet,
        find_outlines(compute_silhouette(camera, trace.layer.vertices, trace.layer.triangles)),
        ink,
        trace.pattern,
    )
    column, row = np.clip(at, -1e4, 1e4).round().astype(int).tolist()
    pale = [0.5 * (share + 255.0) for share in ink]  # so that pixels of this colour are the outline's alone
    for colour, radius in ((BORDER_COLOUR, 4), (pale, 3)):
        cv2.circle(sheet, (column, row), radius, (*colour, OPAQUE), -1, cv2.LINE_AA)


@dataclass(frozen=True, eq=False)
class Cover:
    """Layers and ground over the hidden surface.

    Parameters
    ----------
    occluders
        Ids of the layers (tool, hand) that cover the overlay wherever the image shows them.
    opening
        Ground that the surface may be seen through; None: any. Under other ground the outline is broken, nothing shines
        through, and the image shows a label of that ground if it covers a noticeable share.
    covered
        (H, W) bool: further occluders, as a hand or cottonoids in a real image.
    """

    occluders: Sequence[int] = ()
    opening: Opening | None = None
    covered: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Marks:
    """Lines in addition to the hidden surface's outline.

    Parameters
    ----------
    margin
        Error bound of the surface, one number or (V,) [m]. If positive, a dashed second outline runs at that distance.
    gauge
        Draws the line from the tip to the hidden surface, and its length in millimetres next to the tip.
    before
        Hidden surface before its motion, as in the scan: a dotted grey outline, with an arrow to the present one and
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
    """Text in the image.

    Parameters
    ----------
    doubt
        Reason why the surface's position is unreliable. It is written at the bottom of the image, see `format_warning`,
        in any style. The outline is amber and broken. No error is guaranteed: no margin is drawn, and the number next
        to the tip has no error.
    head
        Lines at the top of the image, in any style and over anything.
    names
        Names of the lines in the legend, which is drawn if there is space.
    moved
        Length and error [m] to be written instead of the mean motion, which has none.
    error
        Error bound of the surface [m], for the text of the styles that measure; None if not available.
    """

    doubt: str = ""
    head: Sequence[str] = ()
    names: LegendNames = DEFAULT_NAMES
    moved: tuple[float, float | None] | None = None
    error: float | None = None


NO_COVER, NO_MARKS, NO_WORDS = Cover(), Marks(), Words()  # Defaults: no occluders, no marks, no text.

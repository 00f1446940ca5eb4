"""Arguments of `composite`: additional lines and text, and occluders of the hidden surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.layer import Layer
from .gauge import DistanceGauge
from .legend import LegendNames
from .outlines import (
    OPAQUE,
    allocate_canvas,
    average_colour,
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
class MarkOutline:
    """Outline of another surface in its layer's colour, with a stroke and gap `pattern` [pixel], and a dot.

    The dot is at `dot_position` (3,) [m].
    """

    layer: Layer
    pattern: tuple[int, int]
    dot_position: np.ndarray


def draw_motion(canvas: np.ndarray, camera: Camera, box: tuple[slice, slice], initial: Layer, layer: Layer) -> None:
    """Draw the hidden surface's earlier outline, dotted, and an arrow from the earlier to the present centroid.

    They are drawn in place on the canvas of the image part `box`, which must contain both surfaces.
    """
    there = find_pixel_box(camera, initial.vertices)
    if there is not None:
        rows, columns = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(there, box, strict=True))
        canvas[rows, columns] = draw_dotted_outline(camera, initial)
    middles = np.stack([initial.vertices.mean(axis=0), layer.vertices.mean(axis=0)])
    ends, _ = camera.crop_to(*box).project(middles)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length >= MIN_ARROW:  # also true for NaN: an end without a pixel
        return
    start, end = (tuple(each) for each in np.clip(ends, -1e4, 1e4).round().astype(int).tolist())
    for ink, width in ((BORDER_COLOUR, 4), (average_colour(BEFORE_COLOUR), 2)):
        cv2.arrowedLine(canvas, start, end, (*ink, OPAQUE), width, cv2.LINE_AA, tipLength=min(0.5, 6.0 / length))


@lru_cache(maxsize=4)
def draw_dotted_outline(camera: Camera, layer: Layer) -> np.ndarray:
    """Draw the dotted outline of a fixed layer on a canvas of the box round it; cached for a camera."""
    box = find_pixel_box(camera, layer.vertices)
    assert box is not None
    part = camera.crop_to(*box)
    sheet = allocate_canvas(part)
    draw_dashes(
        sheet,
        find_outlines(compute_silhouette(part, layer.vertices, layer.triangles)),
        average_colour(BEFORE_COLOUR),
        BEFORE_STROKES,
    )
    return sheet


def draw_outline(canvas: np.ndarray, camera: Camera, outline: MarkOutline) -> None:
    """Draw the outline of another surface in place; nothing if its dot is not projected by the camera."""
    (at,), _ = camera.project(np.asarray(outline.dot_position)[None])
    if not np.isfinite(at).all():
        return
    ink = average_colour(outline.layer.colour)
    draw_dashes(
        canvas,
        find_outlines(compute_silhouette(camera, outline.layer.vertices, outline.layer.triangles)),
        ink,
        outline.pattern,
    )
    column, row = np.clip(at, -1e4, 1e4).round().astype(int).tolist()
    pale = [0.5 * (share + 255.0) for share in ink]  # so that pixels of this colour are the outline's alone
    for colour, radius in ((BORDER_COLOUR, 4), (pale, 3)):
        cv2.circle(canvas, (column, row), radius, (*colour, OPAQUE), -1, cv2.LINE_AA)


@dataclass(frozen=True, eq=False)
class Occluders:
    """Layers over the hidden surface: occluders, and open or closed ground.

    Parameters
    ----------
    occluder_ids
        Ids of the layers (tool, hand) that cover the overlay where the image shows them.
    opening
        Open ground, through which the surface may be seen; None: all layers. Under closed ground the outline is broken,
        the surface does not shine through, and a label is shown if the share of closed ground is large enough.
    occluder_mask
        Mask (H, W) bool of further occluders, such as a hand or cottonoids in a camera image.
    """

    occluder_ids: Sequence[int] = ()
    opening: Opening | None = None
    occluder_mask: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Marks:
    """Lines that are drawn in addition to the hidden surface's outline.

    Parameters
    ----------
    margin
        Error bound [m] of the surface, one number or (V,); if positive, a dashed outline is drawn at that distance.
    gauge
        Gauge whose line is drawn from the tip to the hidden surface, with its length in millimetres; None: no gauge.
    initial
        Hidden surface before its motion, as in the scan: drawn as a dotted grey outline, with an arrow to the present
        surface and the mean motion in millimetres.
    outlines
        Outlines of other surfaces, drawn below that of the hidden surface.
    """

    margin: float | np.ndarray = 0.0
    gauge: DistanceGauge | None = None
    initial: Layer | None = None
    outlines: Sequence[MarkOutline] = ()


@dataclass(frozen=True, eq=False)
class ImageText:
    """Text that is written into the image.

    Parameters
    ----------
    warning
        Reason why the surface's position is unreliable, written at the bottom of the image in any style
        (`format_warning`). The outline is then amber and broken. As no error is guaranteed, no margin is drawn, and the
        number next to the tip has no error.
    header
        Lines at the top of the image, in any style; they may cover everything.
    legend
        Names of the lines for the legend, which is drawn if there is space.
    motion
        Length and error [m] to write instead of the mean motion, which has no error; None: the mean motion.
    error
        Error bound [m] of the surface, for the text of measuring styles; None if not available.
    """

    warning: str = ""
    header: Sequence[str] = ()
    legend: LegendNames = DEFAULT_NAMES
    motion: tuple[float, float | None] | None = None
    error: float | None = None


NO_COVER, NO_MARKS, NO_WORDS = Occluders(), Marks(), ImageText()  # Defaults: no occluders, no marks, no text.

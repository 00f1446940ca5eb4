"""Composition of a hidden surface into the registered camera image, never over the tool."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering import embedding, rasteriser, real_image, shade, surfaces
from ..rendering.layer import Layer, compute_vertex_normals
from ..rendering.parallel import load
from ..rendering.rasteriser import RasterisedSurface, rasterise_surface
from ..rendering.renderer import Picture
from . import distances, window
from .distances import separate_rings
from .gauge import draw_line, write_gauge
from .hud import FONT, HEAD_ROW, LINE_SPACING, MAX_BOTTOM_WIDTH, TEXT_SCALE, Below, format_millimetres, lay, wrap_line
from .legend import Entry, draw_legend, place_sheet
from .marks import (
    BEFORE_COLOUR,
    BEFORE_STROKES,
    NO_COVER,
    NO_MARKS,
    NO_WORDS,
    Cover,
    Marks,
    Words,
    draw_before,
    draw_trace,
)
from .measured import Measure
from .outlines import (
    allocate_sheet,
    compute_ink,
    cut_outlines,
    draw_dashes,
    find_outlines,
    find_pixel_box,
    join_boxes,
    lay_lines,
    to_key,
)
from .styles import STYLES, Opening, Style
from .text_placement import BORDER_DISTANCE, TEXT_DISTANCE
from .window import BORDER_COLOUR, CLOSED_GROUND, FRONT, Lines, Roles, draw_overlay

DOUBTFUL_COLOUR = (0.92, 0.50, 0.05)  # Outline (RGB, 0 to 1) of an unreliable overlay, which is broken as well.
# Text colour of an unreliable overlay: pixels of the outline's colour belong to the outline alone.
WARNING_COLOUR = (1.0, 0.84, 0.5)
POINT_COLOUR = (255.0, 245.0, 190.0)
"""Colour of observed points."""
MARGIN_BRIGHTNESS = 0.75  # Brightness of the margin line relative to the outline, which is the surface itself.
BROKEN_STROKES = (9, 6)  # Stroke and gap lengths of an unreliable outline [pixel].
MARGIN_STROKES = (12, 7)  # Stroke and gap lengths of a margin [pixel].
HIDDEN_STROKES = (9, 6)  # Stroke and gap lengths of an outline under closed ground or a tool [pixel].
HIDDEN_LINE_WIDTH = 2  # Line width of an outline under closed ground or a tool [pixel].
SILHOUETTE_TEXT_WIDTH = 96  # Width of text lines within the silhouette [pixel].
MAX_LOWER_ROWS = 2  # Largest downward shift of the text at the top that avoids lines [text rows].
# Widths of text at the top as shares of the image width; the first that covers no tool is used.
HEAD_WIDTHS = 0.62, 0.5, 0.4, 0.32, 0.25
STYLE_TEXT_DISTANCE = 2 * LINE_SPACING  # Distance of a style's text from the number next to the tip [pixel].


@dataclass(frozen=True, eq=False)
class Overlaid:
    """Image with lines and text: colour (H, W, 3) uint8, and taken (H, W) uint8, above 0 at lines and text.

    `named`: True if a legend names the lines.
    """

    colour: np.ndarray
    taken: np.ndarray
    named: bool = False


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground over the silhouette, in a box of the image.

    Parameters
    ----------
    mask, closed
        (h, w) bool: the silhouette, and the ground that the surface does not shine through.
    words
        Label of the closed ground; empty if it covers too small a share.
    """

    mask: np.ndarray
    closed: np.ndarray
    words: str


def load_kernels(device: str = "cpu") -> None:
    """Load all kernels that draw an image with its overlay, so that the first image does not wait for them."""
    load(device, surfaces, embedding, rasteriser, shade, real_image, window, distances)


@dataclass(frozen=True, eq=False)
class Sketch:
    """Image with its lines, before text.

    Parameters
    ----------
    colour, taken
        See `Overlaid`.
    faint, thin
        (H, W) bool: lines of the margin, and of rings, which text may cover.
    around
        Box of the drawn region; None if nothing is visible.
    ground
        Ground over the surface in the box, if the style shows it.
    """

    colour: np.ndarray
    taken: np.ndarray
    faint: np.ndarray
    thin: np.ndarray
    around: tuple[slice, slice] | None = None
    ground: Ground | None = None


def composite(
    picture: Picture,
    camera: Camera,
    hidden: Layer,
    style: Style = "window",
    cover: Cover = NO_COVER,
    marks: Marks = NO_MARKS,
    words: Words = NO_WORDS,
) -> Overlaid:
    """Draw a hidden surface into an image. On a GPU, depth is copied to the host only for the style "cut".

    Parameters
    ----------
    picture, camera
        Camera image, and its camera.
    hidden
        Surface to show, in its colour; its whole silhouette is used, regardless of occluders.
    style
        "contour": the outline. "window": also the surface, shaded and darker with depth, while the ground around the
        outline is dimmed. "fill": outline and a flat tint. "depth": outline and a tint that is stronger at smaller
        depth, with its scale. "rings": lines of equal distance from the surface on the ground (`distances.py`).
        "cut": an inset (`cut.py`). "none": only warnings. Outlines alone cross occluding layers.
    cover, marks, words
        Occluders of the surface, and additional marks and text.

    Raises
    ------
    ValueError
        An unknown style, or a camera or a mask whose size differs from the image's.

    Examples
    --------
    >>> from ar import Layer, build_lamp, composite, look_at, render
    >>> vertices, triangles = 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> camera = look_at(np.array([0.0, 0.0, 0.4]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    >>> image = render(camera, [Layer("cortex", 1, vertices, triangles)], build_lamp(camera, np.zeros(3)))
    >>> overlay = composite(image, camera, Layer("tumour", 2, 0.5 * vertices, triangles), style="contour")
    >>> overlay.colour.shape, bool(overlay.taken.any())
    ((480, 640, 3), True)
    """
    _check(picture, camera, style, cover.covered)
    if style == "none":
        plain = Overlaid(picture.colour.copy(), np.zeros((camera.height, camera.width), np.uint8))
        write_head(plain, words.head)
        write_doubt(plain, words.doubt)
        return plain
    if words.doubt:
        gauge = None if marks.gauge is None else replace(marks.gauge, error=None)
        hidden, words = replace(hidden, colour=DOUBTFUL_COLOUR), replace(words, error=None)
        marks = replace(marks, margin=0.0, gauge=gauge)
    grown = None
    if np.any(np.asarray(marks.margin) > 0.0):
        normals = compute_vertex_normals(hidden.vertices, hidden.triangles)
        grown = replace(hidden, vertices=hidden.vertices + np.reshape(marks.margin, (-1, 1)) * normals)
    roles = Roles(tuple(cover.occluders), None if cover.opening is None else cover.opening.ids, cover.covered)
    measure = Measure(style, picture, camera, hidden, roles, marks.gauge, words.names.now, words.error)
    surfaces = [layer.vertices for layer in (hidden, grown, marks.before) if layer is not None]
    surfaces += [trace.layer.vertices for trace in marks.traces]
    box = find_pixel_box(camera, np.concatenate([*surfaces, measure.reached]))
    sketch = _draw_sketch(measure, grown, marks, cover.opening, bool(words.doubt), box)
    motion = "" if box is None or marks.before is None else _describe_motion(hidden, marks.before, words)
    drawn = _write_lines(sketch, camera, words, motion)
    if marks.gauge is None and cover.opening is None and style not in ("depth", "rings", "cut"):
        return drawn
    return _write_labels(drawn, sketch, measure, list_legend_entries(hidden, grown, marks, words))


def _draw_sketch(
    measure: Measure, grown: Layer | None, marks: Marks, opening: Opening | None, doubtful: bool,
    box: tuple[slice, slice] | None,
) -> Sketch:  # fmt: skip
    """Draw all lines of a measure, with `grown` (the surface plus its margin); the surfaces are in a `box`."""
    picture, camera, hidden, style, gauge = measure.picture, measure.camera, measure.hidden, measure.style, marks.gauge
    shape = camera.height, camera.width
    taken, faint, thin = np.zeros(shape, np.uint8), np.zeros(shape, bool), np.zeros(shape, bool)
    around = box if gauge is None else join_boxes(box, find_pixel_box(camera, np.stack([gauge.tip, gauge.nearest])))
    if around is None:
        return Sketch(picture.colour.copy(), taken, faint, thin)
    part, device = camera.crop_to(*around), str(picture.drawn.colour.device)
    found = rasterise_surface(part, hidden.vertices, hidden.triangles, device=device)
    under, above, ground, front = allocate_sheet(part), None, None, None
    if marks.before is not None:
        draw_before(under, camera, around, marks.before, hidden)
    if grown is not None:
        bare = under[..., 3] == 0
        wider = rasterise_surface(part, grown.vertices, grown.triangles, device=device).mask
        draw_dashes(under, find_outlines(wider), get_margin_ink(hidden), MARGIN_STROKES, 1)
        faint[around] = bare & (under[..., 3] > 0)
    if opening is not None:
        role = measure.roles.read_roles(picture.segmentation, around)
        ground, front = find_ground(picture.segmentation[around], role, found, opening), role == FRONT
        if measure.roles.covered is not None:  # a mask of the user stays as it is
            front &= ~measure.roles.covered[around]
    for trace in marks.traces:
        draw_trace(under, part, trace)
    draw_broken(under, found, compute_ink(hidden.colour), ground, doubtful)
    if gauge is not None or style == "cut":
        above = allocate_sheet(part)
    if gauge is not None and above is not None:
        draw_line(above, part, gauge)
    bare = under[..., 3] == 0
    crossing = under.copy() if front is not None and front.any() else None  # without the lines of the style
    measure.draw(under, under if above is None else above, around)
    if style == "rings":
        thin[around] = separate_rings(bare & (under[..., 3] > 0))
    lines = Lines(compute_ink(hidden.colour), not doubtful, under, above)
    out, taken[around] = draw_overlay(picture.drawn, around, part, hidden, found, measure.roles, style, lines)
    if front is not None and crossing is not None:
        if not doubtful:
            pieces = cut_outlines(find_outlines(found.mask), front)
            draw_dashes(crossing, pieces, lines.ink, HIDDEN_STROKES, HIDDEN_LINE_WIDTH)
        lay_lines(out[around], crossing, front)
    return Sketch(out, taken, faint, thin, around, ground)


def _describe_motion(hidden: Layer, before: Layer, words: Words) -> str:
    """Describe the surface's mean motion, or the given motion."""
    mean = float(np.linalg.norm(hidden.vertices - before.vertices, axis=1).mean())
    return f"{words.names.motion} {format_millimetres(*((mean, None) if words.moved is None else words.moved))}"


def _write_lines(sketch: Sketch, camera: Camera, words: Words, motion: str) -> Overlaid:
    """Write the lines at the top, the motion and the warning.

    Text at the top and in the corner is placed first and seldom moves. Then the most important text comes first.
    """
    drawn = Overlaid(sketch.colour, sketch.taken.copy())
    write_head(drawn, words.head)
    if motion:
        firm = drawn.taken * ~sketch.faint  # without the margin's line, so that the text does not move
        lay(drawn.colour, firm, wrap_line(motion, MAX_BOTTOM_WIDTH * camera.width), (0, camera.height))
        np.bitwise_or(drawn.taken, firm, out=drawn.taken)
    write_doubt(drawn, words.doubt)
    return drawn


def _write_labels(drawn: Overlaid, sketch: Sketch, measure: Measure, keys: Sequence[Entry]) -> Overlaid:
    """Write the number next to the tip, the label of closed ground, the text of the style, and the legend."""
    out, taken = drawn.colour, drawn.taken
    whole = measure.roles.read_roles(measure.picture.segmentation)
    front = (whole == FRONT).view(np.uint8)
    apart = np.zeros_like(taken)
    if measure.gauge is not None:
        before_it = taken.copy()
        write_gauge(out, taken, measure.camera, measure.gauge, front, sketch.taken, sketch.thin)
        # Keep the text of the style away from the number: they are unrelated.
        square = np.ones((2 * STYLE_TEXT_DISTANCE + 1,) * 2, np.uint8)
        apart = cv2.dilate(((taken > 0) & (before_it == 0)).view(np.uint8), square)
    ground, around = sketch.ground, sketch.around
    if ground is None or around is None:
        measure.lay(out, taken, front, front)
        return drawn
    write_ground(drawn, around, ground, front, sketch.taken)
    sights = (whole != CLOSED_GROUND).view(np.uint8)
    needed = front.copy()
    for each in (sights, needed):
        each[around] |= ground.mask
    measure.lay(out, taken, sights | apart, needed)
    return replace(drawn, named=bool(keys) and place_sheet(out, taken, draw_legend(keys), sights))


def _check(picture: Picture, camera: Camera, style: str, covered: np.ndarray | None) -> None:
    """Raise ValueError as `composite` does."""
    if style not in STYLES:
        raise ValueError(f"there is no overlay style {style!r}: choose one of {', '.join(STYLES)}.")
    shape = picture.drawn.colour.shape[1:]
    if shape != (camera.height, camera.width):
        raise ValueError(f"the image is {shape}, the camera {(camera.height, camera.width)}.")
    if covered is not None and (covered.shape != shape or covered.dtype != bool):
        given = f"{covered.shape} of {covered.dtype}"
        raise ValueError(f"covered is {given}: give a mask (H, W) of bool as large as the image, {shape}.")


def find_ground(segmentation: np.ndarray, role: np.ndarray, found: RasterisedSurface, opening: Opening) -> Ground:
    """Determine the ground over a surface in a box, from the segmentation and roles (h, w) uint8."""
    mask = found.mask
    counts = np.bincount(segmentation[mask & (role != FRONT)], minlength=256)
    layers = np.flatnonzero(counts).tolist()
    return Ground(mask, role == CLOSED_GROUND, opening.describe({layer: int(counts[layer]) for layer in layers}))


def draw_broken(
    sheet: np.ndarray, found: RasterisedSurface, ink: tuple[float, float, float], ground: Ground | None, doubtful: bool
) -> None:
    """Draw the broken parts of an outline, in place: all of an unreliable one, and those under closed ground."""
    if doubtful:
        draw_dashes(sheet, find_outlines(found.mask), ink, BROKEN_STROKES)
    elif ground is not None and ground.closed.any():
        pieces = cut_outlines(find_outlines(ground.mask), ground.closed)
        draw_dashes(sheet, pieces, ink, HIDDEN_STROKES, HIDDEN_LINE_WIDTH)


def get_margin_ink(hidden: Layer) -> tuple[float, ...]:
    """Compute the colour of the margin line round a surface."""
    return tuple(MARGIN_BRIGHTNESS * share for share in compute_ink(hidden.colour))


def list_legend_entries(hidden: Layer, grown: Layer | None, marks: Marks, words: Words) -> tuple[Entry, ...]:
    """List legend entries of the drawn lines that have a name."""
    names = words.names
    named = zip(marks.traces, names.traces, strict=False)
    entries = [
        Entry(
            names.now, to_key(compute_ink(hidden.colour)), BROKEN_STROKES if words.doubt else None, HIDDEN_LINE_WIDTH
        ),
        *([] if grown is None else [Entry(names.margin, get_margin_ink(hidden), MARGIN_STROKES, 1)]),
        *(Entry(name, to_key(compute_ink(trace.layer.colour)), trace.pattern) for trace, name in named),
        *([] if marks.before is None else [Entry(names.before, compute_ink(BEFORE_COLOUR), BEFORE_STROKES)]),
    ]
    return tuple(entry for entry in entries if entry.name)


def draw_points(drawn: Overlaid, camera: Camera, points: np.ndarray, where: np.ndarray) -> None:
    """Draw a small dot at each of the points (n, 3) [m] where `where` (H, W) bool is true and no line is; in place."""
    pixels, _ = camera.project(points)
    here = pixels[np.isfinite(pixels).all(axis=1)].round().astype(int)
    here = here[((here >= 0) & (here < (camera.width, camera.height))).all(axis=1)]
    near = cv2.dilate(drawn.taken, np.ones((7, 7), np.uint8))  # no dot on letters
    for column, row in here[where[here[:, 1], here[:, 0]] & (near[here[:, 1], here[:, 0]] == 0)].tolist():
        cv2.circle(drawn.colour, (column, row), 2, BORDER_COLOUR, -1)
        cv2.circle(drawn.colour, (column, row), 1, POINT_COLOUR, -1)


def write_ground(
    drawn: Overlaid, box: tuple[slice, slice], ground: Ground, front: np.ndarray, lines_there: np.ndarray
) -> None:
    """Write the label of closed ground over the surface, in place; front and lines (H, W) uint8 as in `Below`."""
    if not ground.words:
        return
    there = cv2.moments((ground.mask & ground.closed).view(np.uint8), binaryImage=True)
    lines = format_ground(ground.words)
    wide = max(cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines)
    column, row = there["m10"] / there["m00"] + box[1].start, there["m01"] / there["m00"] + box[0].start
    wish = round(column - wide / 2), round(row - LINE_SPACING * len(lines) / 2)
    lay(drawn.colour, drawn.taken, lines, wish, TEXT_SCALE, needed=True, below=Below(front, lines_there))


def format_ground(words: str) -> list[str]:
    """Break the ground's label into short lines, which fit into a silhouette."""
    return wrap_line(words, SILHOUETTE_TEXT_WIDTH)


def format_head_lines(texts: Sequence[str], tool: np.ndarray) -> list[str]:
    """Break text for the top of an image into lines, as wide as possible without covering a tool (H, W) bool."""
    width = tool.shape[1]
    tried = [[part for text in texts for part in wrap_line(text, share * width)] for share in HEAD_WIDTHS]
    for lines in tried:
        long = max((cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines), default=0)
        rows = slice(HEAD_ROW - TEXT_DISTANCE, HEAD_ROW + LINE_SPACING * len(lines) + TEXT_DISTANCE)
        if not tool[rows, : BORDER_DISTANCE + long + TEXT_DISTANCE].any():
            return lines
    return tried[0]


def write_head(drawn: Overlaid, lines: Sequence[str]) -> None:
    """Draw text lines in the top-left corner, below the orientation letter, in place; may cover other lines."""
    free, middle = drawn.taken.copy(), len(drawn.taken) // 2
    below = HEAD_ROW + LINE_SPACING * (len(lines) + MAX_LOWER_ROWS)
    free[:HEAD_ROW] = free[middle - HEAD_ROW // 2 : middle + HEAD_ROW // 2] = 1  # kept free for the orientation letters
    free[below:] = 1  # text may cover a line, but not the centre of the image
    before = free.copy()
    lay(drawn.colour, free, lines, (0, HEAD_ROW), needed=True, below=Below(lines=drawn.taken))
    drawn.taken[free > before] = 1


def write_doubt(drawn: Overlaid, doubt: str) -> None:
    """Write the reason why a result is unreliable in the bottom-left corner, in place; may cover other text."""
    height, width = drawn.taken.shape
    lines, ink = format_warning(doubt, width), compute_ink(WARNING_COLOUR)
    lay(drawn.colour, drawn.taken, lines, (0, height), TEXT_SCALE, ink, needed=True)


def format_warning(doubt: str, width: int) -> list[str]:
    """Break a warning into lines for an image of this width [pixel]: its reason, and its consequence."""
    return [line for part in doubt.split(": ") for line in wrap_line(part, MAX_BOTTOM_WIDTH * width)]

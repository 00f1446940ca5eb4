"""Composition of a hidden surface into a registered camera image, without covering tools."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering import embedding, rasteriser, real_image, shade, surfaces
from ..rendering.layer import Layer, compute_vertex_normals
from ..rendering.parallel import load_modules
from ..rendering.rasteriser import RasterisedSurface, rasterise_surface
from ..rendering.renderer import Picture
from . import distances, window
from .distances import remove_labels
from .gauge import draw_gauge_line, write_distance
from .hud import (
    FONT,
    HEAD_ROW,
    LINE_SPACING,
    MAX_BOTTOM_WIDTH,
    TEXT_SCALE,
    Hideable,
    format_millimetres,
    place_text,
    wrap_line,
)
from .legend import LegendEntry, draw_legend, place_inset
from .marks import (
    BEFORE_COLOUR,
    BEFORE_STROKES,
    NO_COVER,
    NO_MARKS,
    NO_WORDS,
    ImageText,
    Marks,
    Occluders,
    draw_motion,
    draw_outline,
)
from .measured import Measurement
from .outlines import (
    allocate_canvas,
    average_colour,
    blend_canvas,
    clip_to_mask,
    draw_dashes,
    find_outlines,
    find_pixel_box,
    join_boxes,
    shift_shade,
)
from .styles import STYLES, Opening, Style
from .text_placement import BORDER_DISTANCE, TEXT_DISTANCE
from .window import BORDER_COLOUR, CLOSED_GROUND, FRONT, LayerRoles, OverlayLines, draw_overlay

DOUBTFUL_COLOUR = (0.92, 0.50, 0.05)  # Outline (RGB, 0 to 1) of an unreliable overlay, which is broken as well.
WARNING_COLOUR = (1.0, 0.84, 0.5)  # Text colour of an unreliable overlay; differs from the outline's.
POINT_COLOUR = (255.0, 245.0, 190.0)  # Colour of observed points.
MARGIN_BRIGHTNESS = 0.75  # Brightness of the margin line relative to the surface's outline.
BROKEN_STROKES = (9, 6)  # Stroke and gap lengths of an unreliable outline [pixel].
MARGIN_STROKES = (12, 7)  # Stroke and gap lengths of a margin [pixel].
HIDDEN_STROKES = (9, 6)  # Stroke and gap lengths of an outline under closed ground or a tool [pixel].
HIDDEN_LINE_WIDTH = 2  # Line width of an outline under closed ground or a tool [pixel].
SILHOUETTE_TEXT_WIDTH = 96  # Width of text lines within the silhouette [pixel].
MAX_LOWER_ROWS = 2  # Largest downward shift of the text at the top to avoid lines [text rows].
HEAD_WIDTHS = 0.62, 0.5, 0.4, 0.32, 0.25  # Text widths at the top / image width; the first that covers no tool is used.
STYLE_TEXT_DISTANCE = 2 * LINE_SPACING  # Distance of a style's text from the number next to the tip [pixel].


@dataclass(frozen=True, eq=False)
class Overlaid:
    """Image with an overlay: `colour` (H, W, 3) uint8, and mask `taken` (H, W) uint8 of lines and text.

    `named` is True if a legend names the lines.
    """

    colour: np.ndarray
    taken: np.ndarray
    named: bool = False


@dataclass(frozen=True, eq=False)
class Ground:
    """Layers over the silhouette in a box of the image.

    Parameters
    ----------
    silhouette, opaque
        Masks (h, w) bool: of the silhouette, and of closed ground, through which the surface does not shine.
    label
        Label of the closed ground; empty if its share is too small.
    """

    silhouette: np.ndarray
    opaque: np.ndarray
    label: str


def load_kernels(device: str = "cpu") -> None:
    """Load all kernels that draw images and overlays, so that the first image is not delayed."""
    load_modules(device, surfaces, embedding, rasteriser, shade, real_image, window, distances)


@dataclass(frozen=True, eq=False)
class LineDrawing:
    """Image with the lines of an overlay, before text is added.

    Parameters
    ----------
    colour, occupied
        Image, and mask of its lines, as in `Overlaid`.
    margin_lines, ring_lines
        Masks (H, W) bool of the margin's line and of the rings, which text may cover.
    box
        Box of the drawn region; None if nothing is drawn.
    ground
        Layers over the silhouette in the box; None if no open ground is given.
    """

    colour: np.ndarray
    occupied: np.ndarray
    margin_lines: np.ndarray
    ring_lines: np.ndarray
    box: tuple[slice, slice] | None = None
    ground: Ground | None = None


def composite(
    picture: Picture, camera: Camera, hidden: Layer, style: Style = "window", cover: Occluders = NO_COVER,
    marks: Marks = NO_MARKS, words: ImageText = NO_WORDS,
) -> Overlaid:  # fmt: skip
    """Draw a hidden surface into an image; on a GPU, depth is copied to the host only for the style "cut".

    Parameters
    ----------
    picture, camera
        Image to draw on, and its camera.
    hidden
        Surface to show, in its own colour; occluders do not change its silhouette.
    style
        "contour": the outline. "window": also the surface, shaded and darker with depth, while the ground round the
        outline is dimmed. "fill": outline and uniform tint. "depth": outline, and a tint with scale that is stronger at
        smaller depth. "rings": lines of equal distance from the surface, on the ground (`distances.py`). "cut": a
        cross-section in an inset (`cut.py`). "none": only header and warning. Only outlines cross occluding layers.
    cover, marks, words
        Occluders of the surface; additional lines; additional text.

    Raises
    ------
    ValueError
        The style is unknown, or the size of the camera or of a mask differs from the image's.

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
    _check_inputs(picture, camera, style, cover.occluder_mask)
    if style == "none":
        plain = Overlaid(picture.colour.copy(), np.zeros((camera.height, camera.width), np.uint8))
        write_header(plain, words.header)
        write_warning(plain, words.warning)
        return plain
    if words.warning:
        gauge = None if marks.gauge is None else replace(marks.gauge, error=None)
        hidden, words = replace(hidden, colour=DOUBTFUL_COLOUR), replace(words, error=None)
        marks = replace(marks, margin=0.0, gauge=gauge)
    grown = None
    if np.any(np.asarray(marks.margin) > 0.0):
        normals = compute_vertex_normals(hidden.vertices, hidden.triangles)
        grown = replace(hidden, vertices=hidden.vertices + np.reshape(marks.margin, (-1, 1)) * normals)
    opening_ids = None if cover.opening is None else cover.opening.ids
    roles = LayerRoles(tuple(cover.occluder_ids), opening_ids, cover.occluder_mask)
    measure = Measurement(style, picture, camera, hidden, roles, marks.gauge, words.legend.current, words.error)
    surfaces = [layer.vertices for layer in (hidden, grown, marks.initial) if layer is not None]
    surfaces += [trace.layer.vertices for trace in marks.outlines]
    box = find_pixel_box(camera, np.concatenate([*surfaces, measure.extent]))
    sketch = _draw_lines(measure, grown, marks, cover.opening, bool(words.warning), box)
    motion = "" if box is None or marks.initial is None else _describe_motion(hidden, marks.initial, words)
    drawn = _write_lines(sketch, camera, words, motion)
    if marks.gauge is None and cover.opening is None and style not in ("depth", "rings", "cut"):
        return drawn
    return _write_labels(drawn, sketch, measure, list_legend_entries(hidden, grown, marks, words))


def _draw_lines(
    measure: Measurement, margin_layer: Layer | None, marks: Marks, opening: Opening | None, is_unreliable: bool,
    box: tuple[slice, slice] | None,
) -> LineDrawing:  # fmt: skip
    """Draw all lines of a style; `margin_layer` is the surface with its margin, and `box` contains the surfaces."""
    picture, camera, hidden, style, gauge = measure.image, measure.camera, measure.layer, measure.style, marks.gauge
    shape = camera.height, camera.width
    taken, faint, thin = np.zeros(shape, np.uint8), np.zeros(shape, bool), np.zeros(shape, bool)
    ends = None if gauge is None else find_pixel_box(camera, np.stack([gauge.tip, gauge.nearest_point]))
    around = box if gauge is None else join_boxes(box, ends)
    if around is None:
        return LineDrawing(picture.colour.copy(), taken, faint, thin)
    part, device = camera.crop_to(*around), str(picture.drawn.colour.device)
    found = rasterise_surface(part, hidden.vertices, hidden.triangles, device=device)
    under, above, ground, front = allocate_canvas(part), None, None, None
    if marks.initial is not None:
        draw_motion(under, camera, around, marks.initial, hidden)
    if margin_layer is not None:
        bare = under[..., 3] == 0
        wider = rasterise_surface(part, margin_layer.vertices, margin_layer.triangles, device=device).mask
        draw_dashes(under, find_outlines(wider), tint_margin(hidden), MARGIN_STROKES, 1)
        faint[around] = bare & (under[..., 3] > 0)
    if opening is not None:
        role = measure.roles.read_roles(picture.segmentation, around)
        ground, front = find_ground(picture.segmentation[around], role, found, opening), role == FRONT
        if measure.roles.occluder_mask is not None:  # a mask of the user stays as it is
            front &= ~measure.roles.occluder_mask[around]
    for trace in marks.outlines:
        draw_outline(under, part, trace)
    draw_broken_outline(under, found, average_colour(hidden.colour), ground, is_unreliable)
    if gauge is not None or style == "cut":
        above = allocate_canvas(part)
    if gauge is not None and above is not None:
        draw_gauge_line(above, part, gauge)
    bare = under[..., 3] == 0
    crossing = under.copy() if front is not None and front.any() else None  # without the lines of the style
    measure.draw(under, under if above is None else above, around)
    if style == "rings":
        thin[around] = remove_labels(bare & (under[..., 3] > 0))
    lines = OverlayLines(average_colour(hidden.colour), not is_unreliable, under, above)
    out, taken[around] = draw_overlay(picture.drawn, around, part, hidden, found, measure.roles, style, lines)
    if front is not None and crossing is not None:
        if not is_unreliable:
            pieces = clip_to_mask(find_outlines(found.mask), front)
            draw_dashes(crossing, pieces, lines.colour, HIDDEN_STROKES, HIDDEN_LINE_WIDTH)
        blend_canvas(out[around], crossing, front)
    return LineDrawing(out, taken, faint, thin, around, ground)


def _describe_motion(layer: Layer, initial_layer: Layer, text: ImageText) -> str:
    """Describe the surface's mean motion, or the motion given in `text`."""
    mean = float(np.linalg.norm(layer.vertices - initial_layer.vertices, axis=1).mean())
    return f"{text.legend.motion} {format_millimetres(*((mean, None) if text.motion is None else text.motion))}"


def _write_lines(drawing: LineDrawing, camera: Camera, text: ImageText, motion: str) -> Overlaid:
    """Write the header, the motion and the warning; return the image.

    Texts at the top and in the corners are placed first, so that they seldom move; other texts follow by importance.
    """
    drawn = Overlaid(drawing.colour, drawing.occupied.copy())
    write_header(drawn, text.header)
    if motion:
        firm = drawn.taken * ~drawing.margin_lines  # without the margin's line, so that the text does not move
        place_text(drawn.colour, firm, wrap_line(motion, MAX_BOTTOM_WIDTH * camera.width), (0, camera.height))
        np.bitwise_or(drawn.taken, firm, out=drawn.taken)
    write_warning(drawn, text.warning)
    return drawn


def _write_labels(image: Overlaid, drawing: LineDrawing, measure: Measurement, keys: Sequence[LegendEntry]) -> Overlaid:
    """Write the tip's distance, the label of closed ground, the style's text and the legend; return the image."""
    out, taken = image.colour, image.taken
    whole = measure.roles.read_roles(measure.image.segmentation)
    front = (whole == FRONT).view(np.uint8)
    apart = np.zeros_like(taken)
    if measure.gauge is not None:
        before_it = taken.copy()
        write_distance(out, taken, measure.camera, measure.gauge, front, drawing.occupied, drawing.ring_lines)
        # Keep the text of the style away from the number: they are unrelated.
        square = np.ones((2 * STYLE_TEXT_DISTANCE + 1,) * 2, np.uint8)
        apart = cv2.dilate(((taken > 0) & (before_it == 0)).view(np.uint8), square)
    ground, around = drawing.ground, drawing.box
    if ground is None or around is None:
        measure.draw_insets(out, taken, front, front)
        return image
    write_ground_label(image, around, ground, front, drawing.occupied)
    sights = (whole != CLOSED_GROUND).view(np.uint8)
    needed = front.copy()
    for each in (sights, needed):
        each[around] |= ground.silhouette
    measure.draw_insets(out, taken, sights | apart, needed)
    return replace(image, named=bool(keys) and place_inset(out, taken, draw_legend(keys), sights))


def _check_inputs(picture: Picture, camera: Camera, style: str, occlusion_mask: np.ndarray | None) -> None:
    """Raise ValueError for an unknown style, or a camera or mask of another size than the image."""
    if style not in STYLES:
        raise ValueError(f"there is no overlay style {style!r}: choose one of {', '.join(STYLES)}.")
    shape = picture.drawn.colour.shape[1:]
    if shape != (camera.height, camera.width):
        raise ValueError(f"the image is {shape}, the camera {(camera.height, camera.width)}.")
    if occlusion_mask is not None and (occlusion_mask.shape != shape or occlusion_mask.dtype != bool):
        given = f"{occlusion_mask.shape} of {occlusion_mask.dtype}"
        raise ValueError(f"covered is {given}: give a mask (H, W) of bool as large as the image, {shape}.")


def find_ground(segmentation: np.ndarray, roles: np.ndarray, surface: RasterisedSurface, opening: Opening) -> Ground:
    """Return the ground over a rasterised surface in a box, from segmentation and roles (h, w) uint8."""
    mask = surface.mask
    counts = np.bincount(segmentation[mask & (roles != FRONT)], minlength=256)
    layers = np.flatnonzero(counts).tolist()
    return Ground(mask, roles == CLOSED_GROUND, opening.describe({layer: int(counts[layer]) for layer in layers}))


def draw_broken_outline(
    canvas: np.ndarray, surface: RasterisedSurface, colour: tuple[float, float, float], ground: Ground | None,
    is_unreliable: bool,
) -> None:  # fmt: skip
    """Draw broken parts of an outline in place: the whole of an unreliable one, else the parts under closed ground."""
    if is_unreliable:
        draw_dashes(canvas, find_outlines(surface.mask), colour, BROKEN_STROKES)
    elif ground is not None and ground.opaque.any():
        pieces = clip_to_mask(find_outlines(ground.silhouette), ground.opaque)
        draw_dashes(canvas, pieces, colour, HIDDEN_STROKES, HIDDEN_LINE_WIDTH)


def tint_margin(layer: Layer) -> tuple[float, ...]:
    """Return the colour of the margin line round a surface, which is darker than the surface's."""
    return tuple(MARGIN_BRIGHTNESS * share for share in average_colour(layer.colour))


def list_legend_entries(layer: Layer, margin: Layer | None, marks: Marks, text: ImageText) -> tuple[LegendEntry, ...]:
    """Return the legend entries of the drawn lines that have a name."""
    names = text.legend
    named, pattern = zip(marks.outlines, names.outlines, strict=False), BROKEN_STROKES if text.warning else None
    entries = [
        LegendEntry(names.current, shift_shade(average_colour(layer.colour)), pattern, HIDDEN_LINE_WIDTH),
        *([] if margin is None else [LegendEntry(names.margin, tint_margin(layer), MARGIN_STROKES, 1)]),
        *(LegendEntry(name, shift_shade(average_colour(trace.layer.colour)), trace.pattern) for trace, name in named),
        *([] if marks.initial is None else [LegendEntry(names.initial, average_colour(BEFORE_COLOUR), BEFORE_STROKES)]),
    ]
    return tuple(entry for entry in entries if entry.name)


def draw_points(overlay: Overlaid, camera: Camera, points: np.ndarray, mask: np.ndarray) -> None:
    """Draw dots at points (n, 3) [m] where `mask` (H, W) bool is True and there is no line, in place."""
    pixels, _ = camera.project(points)
    here = pixels[np.isfinite(pixels).all(axis=1)].round().astype(int)
    here = here[((here >= 0) & (here < (camera.width, camera.height))).all(axis=1)]
    near = cv2.dilate(overlay.taken, np.ones((7, 7), np.uint8))  # no dot on letters
    for column, row in here[mask[here[:, 1], here[:, 0]] & (near[here[:, 1], here[:, 0]] == 0)].tolist():
        cv2.circle(overlay.colour, (column, row), 2, BORDER_COLOUR, -1)
        cv2.circle(overlay.colour, (column, row), 1, POINT_COLOUR, -1)


def write_ground_label(
    overlay: Overlaid, box: tuple[slice, slice], ground: Ground, front: np.ndarray, lines_mask: np.ndarray
) -> None:
    """Write the label of closed ground over the surface, in place; `front` and `lines_mask` are as in `Hideable`."""
    if not ground.label:
        return
    there = cv2.moments((ground.silhouette & ground.opaque).view(np.uint8), binaryImage=True)
    lines = wrap_label(ground.label)
    wide = max(cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines)
    column, row = there["m10"] / there["m00"] + box[1].start, there["m01"] / there["m00"] + box[0].start
    wish = round(column - wide / 2), round(row - LINE_SPACING * len(lines) / 2)
    place_text(overlay.colour, overlay.taken, lines, wish, TEXT_SCALE, force=True, parts=Hideable(front, lines_mask))


def wrap_label(label: str) -> list[str]:
    """Break the label of closed ground into short lines that fit into a silhouette."""
    return wrap_line(label, SILHOUETTE_TEXT_WIDTH)


def wrap_header(texts: Sequence[str], tool_mask: np.ndarray) -> list[str]:
    """Break header text into lines, as wide as possible without covering `tool_mask` (H, W) bool."""
    width = tool_mask.shape[1]
    tried = [[part for text in texts for part in wrap_line(text, share * width)] for share in HEAD_WIDTHS]
    for lines in tried:
        long = max((cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines), default=0)
        rows = slice(HEAD_ROW - TEXT_DISTANCE, HEAD_ROW + LINE_SPACING * len(lines) + TEXT_DISTANCE)
        if not tool_mask[rows, : BORDER_DISTANCE + long + TEXT_DISTANCE].any():
            return lines
    return tried[0]


def write_header(overlay: Overlaid, lines: Sequence[str]) -> None:
    """Write header lines in the top-left corner, below the orientation letter, in place; they may cover lines."""
    free, middle = overlay.taken.copy(), len(overlay.taken) // 2
    below = HEAD_ROW + LINE_SPACING * (len(lines) + MAX_LOWER_ROWS)
    free[:HEAD_ROW] = free[middle - HEAD_ROW // 2 : middle + HEAD_ROW // 2] = 1  # kept free for the orientation letters
    free[below:] = 1  # text may cover a line, but not the centre of the image
    before = free.copy()
    place_text(overlay.colour, free, lines, (0, HEAD_ROW), force=True, parts=Hideable(lines=overlay.taken))
    overlay.taken[free > before] = 1


def write_warning(overlay: Overlaid, reason: str) -> None:
    """Write the reason why a result is unreliable in the bottom-left corner, in place; it may cover other text."""
    height, width = overlay.taken.shape
    lines, ink = format_warning(reason, width), average_colour(WARNING_COLOUR)
    place_text(overlay.colour, overlay.taken, lines, (0, height), TEXT_SCALE, ink, force=True)


def format_warning(reason: str, width: int) -> list[str]:
    """Break a warning into lines for an image of `width` [pixel]; reason and consequence have separate lines."""
    return [line for part in reason.split(": ") for line in wrap_line(part, MAX_BOTTOM_WIDTH * width)]

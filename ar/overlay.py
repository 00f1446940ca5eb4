"""What lies under the surface, drawn into the picture in register, and never over the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from . import place, rasteriser, shade, window
from .camera import Camera
from .hud import FINE, HEAD, NARROW, folded, lay, millimetres
from .layer import Layer, vertex_normals
from .parallel import load
from .rasteriser import seen
from .renderer import Picture
from .window import DARK, NEAR_EDGE, SURROUND, Lines, covering, overlaid

Style = Literal["window", "contour", "fill", "none"]
# What may not be relied on is drawn in amber, and broken, with words in a paler one, so that pixels of the outline are
# the outline's alone; what was believed before in grey, and dotted.
DOUBTFUL = (1.0, 0.68, 0.16)
WARNING = (1.0, 0.84, 0.5)
BEFORE = (0.86, 0.88, 0.90)
SEEN = (255.0, 245.0, 190.0)
"""Ink of points that are seen."""
# Of the outline's brightness: that of the margin round it, which is no place of the surface.
FAINT = 0.75
# Lengths of the outlines' strokes and gaps [pixel].
BROKEN, DASHED, DOTTED = (9, 6), (7, 7), (2, 5)
# Scale of the number beside the line.
GAUGE = 0.6
# From the end of the gauge's line to its number [pixel].
BESIDE = 10
# A motion of fewer pixels has no arrow.
LEAST_ARROW = 4.0
# Points of a straight line that a lens bends; pixels from one to the next that is looked at first.
BENDS, COARSE = 33, 16
# Of a sheet's fourth channel, where a line covers what is under it.
OPAQUE = 255


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
    """

    tip: np.ndarray
    nearest: np.ndarray
    read: float | None = None
    error: float | None = None

    @property
    def distance(self) -> float:
        """[m]."""
        return float(np.linalg.norm(np.asarray(self.tip) - self.nearest)) if self.read is None else self.read

    def __str__(self) -> str:
        """As it is printed beside the line."""
        return millimetres(self.distance, self.error)


@dataclass(frozen=True, eq=False)
class Overlaid:
    """A picture with lines and words in it: colour (H, W, 3) uint8, and taken (H, W) uint8, above 0 where they are."""

    colour: np.ndarray
    taken: np.ndarray


@dataclass(frozen=True, eq=False)
class Trace:
    """The outline of another surface, in its layer's colour: strokes and gaps of so many pixels, and a dot at a point.

    The point is `dot` (3,) [m].
    """

    layer: Layer
    pattern: tuple[int, int]
    dot: np.ndarray


def load_kernels(device: str = "cpu") -> None:
    """Load all kernels that draw a picture with its overlay, so that the first does not wait for them."""
    load(device, place, rasteriser, shade, window)


def composite(
    picture: Picture,
    camera: Camera,
    hidden: Layer,
    occluders: Sequence[int] = (),
    style: Style = "window",
    margin: float | np.ndarray = 0.0,
    gauge: Gauge | None = None,
    before: Layer | None = None,
    doubt: str = "",
    traces: Sequence[Trace] = (),
    moved: tuple[float, float] | None = None,
    head: Sequence[str] = (),
) -> Overlaid:
    """The picture with a hidden surface drawn into it. On a card, no depth comes back from it.

    Parameters
    ----------
    picture, camera
        What the camera sees, and that camera.
    hidden
        The surface to show; its colour is used, its place is its silhouette whatever lies in front.
    occluders
        Ids of the layers (tool, hand) that cover the overlay wherever the picture shows them.
    style
        "contour": the outline. "window": besides, the ground is dimmed round the outline and the surface shows through,
        shaded, and darker the deeper it lies. "fill": besides the outline, a flat tint. "none": nothing but a doubt.
    margin
        One number or (V,) [m]: how uncertain the surface is. Where positive, a dashed second outline runs that far out.
    gauge
        Draws the line from the tip to the hidden surface, and its length in millimetres.
    before
        Where the hidden surface was before, as in the scan: a dotted grey outline, with an arrow from there to here and
        the mean motion in millimetres.
    doubt
        Why the surface's place may not be relied on. It is written at the picture's foot, see `doubt_lines`, whatever
        the style. The outline is amber and broken. Nothing is promised: no margin is drawn, and the number beside the
        line has no error.
    traces
        Outlines of other surfaces, drawn under the hidden one's.
    moved
        Length and error [m] to be written in place of the mean motion, which has none.
    head
        Lines that are written at the picture's head, whatever the style and whatever lies there.

    Raises
    ------
    ValueError
        An unknown style, or a camera whose size is not the picture's.
    """
    if style not in Style.__args__:
        raise ValueError(f"there is no overlay style {style!r}: choose one of {', '.join(Style.__args__)}.")
    shape = picture.drawn.colour.shape[1:]
    if shape != (camera.height, camera.width):
        raise ValueError(f"the picture is {shape}, the camera {(camera.height, camera.width)}.")
    taken = np.zeros(shape, np.uint8)
    if style == "none":
        plain = Overlaid(picture.colour.copy(), taken)
        write_head(plain, head)
        write_doubt(plain, doubt)
        return plain
    if doubt:
        hidden, margin = replace(hidden, colour=DOUBTFUL), 0.0
        gauge = None if gauge is None else replace(gauge, error=None)
    grown = None
    if np.any(np.asarray(margin) > 0.0):
        normals = vertex_normals(hidden.vertices, hidden.triangles)
        grown = replace(hidden, vertices=hidden.vertices + np.reshape(margin, (-1, 1)) * normals)
    surfaces = [layer.vertices for layer in (hidden, grown, before) if layer is not None]
    surfaces += [trace.layer.vertices for trace in traces]
    box = box_around(camera, np.concatenate(surfaces))
    around = box if gauge is None else joined(box, box_around(camera, np.stack([gauge.tip, gauge.nearest])))
    if around is None:
        out = picture.colour.copy()
    else:
        part, device = camera.cropped(*around), str(picture.drawn.colour.device)
        found = seen(part, hidden.vertices, hidden.triangles, device=device)
        under, above = blank(part), None
        if before is not None:
            draw_before(under, camera, around, before, hidden)
        ink = ink_of(hidden.colour)
        if grown is not None:
            margin_mask = seen(part, grown.vertices, grown.triangles, device=device).mask
            dash(under, outlines(margin_mask), [FAINT * share for share in ink], DASHED, 1)
        if doubt:
            dash(under, outlines(found.mask), ink, BROKEN)
        for trace in traces:
            draw_trace(under, part, trace)
        if gauge is not None:
            above = blank(part)
            draw_line(above, part, gauge)
        lines = Lines(ink, not doubt, under, above)
        out, taken[around] = overlaid(picture.drawn, around, part, hidden, found, occluders, style, lines)
    drawn = Overlaid(out, taken)
    # Head and corner first, so that their words seldom move; then by importance, for some are left out without room.
    write_head(drawn, head)
    if before is not None and box is not None:
        motion = float(np.linalg.norm(hidden.vertices - before.vertices, axis=1).mean())
        said = millimetres(motion) if moved is None else millimetres(*moved)
        lay(out, taken, [f"moved {said}"], (0, camera.height))
    write_doubt(drawn, doubt)
    if gauge is not None:
        write_gauge(drawn, camera, gauge, cv2.LUT(picture.segmentation, covering(tuple(occluders))))
    return drawn


def joined(a: tuple[slice, slice] | None, b: tuple[slice, slice] | None) -> tuple[slice, slice] | None:
    """The rows and columns that hold two boxes."""
    if a is None or b is None:
        return a or b
    rows, columns = (slice(min(i.start, j.start), max(i.stop, j.stop)) for i, j in zip(a, b, strict=True))
    return rows, columns


def ink_of(colour: np.ndarray | tuple[float, float, float]) -> tuple[float, float, float]:
    """The mean of colours (3,) or (V, 3), sRGB in [0, 1], as lines are drawn: whole numbers of 0 .. 255."""
    red, green, blue = np.rint(255.0 * np.asarray(colour, np.float64).reshape(-1, 3).mean(axis=0)).tolist()
    return red, green, blue


def blank(camera: Camera) -> np.ndarray:
    """A sheet (h, w, 4) uint8 for lines: colour times coverage, and coverage."""
    return np.zeros((camera.height, camera.width, 4), np.uint8)


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


def box_around(camera: Camera, points: np.ndarray) -> tuple[slice, slice] | None:
    """Rows and columns that hold the pixels of points (V, 3) and `SURROUND` more; None when none is in the picture."""
    pixels, depth = camera.project(points)
    if not (depth > 0.0).all():
        return slice(0, camera.height), slice(0, camera.width)
    if camera.lens is not None:
        pixels = corners_between(camera, points)
        if not len(pixels):
            return None
    low = np.maximum(np.floor(pixels.min(axis=0)) - SURROUND, 0.0).astype(int).tolist()
    high = np.minimum(np.ceil(pixels.max(axis=0)) + SURROUND + 1.0, (camera.width, camera.height)).astype(int).tolist()
    box = slice(low[1], high[1]), slice(low[0], high[0])
    return box if all(side.start < side.stop for side in box) else None


def corners_between(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Corners (n, 2) of the pixels that may lie between points (V, 3) in front of a camera with a lens.

    A lens bends the lines between points, but not out of the box that holds them in its straight picture.
    """
    ends, _ = replace(camera, lens=None).project(points)
    # Every few pixels first, with as much room as the straight picture changes from one of these to the next.
    step = COARSE if min(camera.width, camera.height) > 2 * COARSE else 1
    few = camera.straight[::step, ::step]
    steps = [np.abs(np.diff(few, axis=axis)).reshape(-1, 2) for axis in (0, 1)]
    room = 1.0 + np.nan_to_num(np.concatenate(steps)).max(axis=0, initial=0.0)
    rows, columns = (step * where for where in _inside(few, ends.min(axis=0) - room, ends.max(axis=0) + room))
    corners = np.zeros((0, 2))
    if len(rows):
        top, left = max(rows[0] - step, 0), max(columns[0] - step, 0)
        part = camera.straight[top : rows[-1] + step + 1, left : columns[-1] + step + 1]
        rows, columns = _inside(part, ends.min(axis=0), ends.max(axis=0))
        corners = np.array([(left + columns[end], top + rows[end]) for end in (0, -1) if len(rows)]).reshape(-1, 2)
    near, _ = camera.project(points)
    return np.concatenate([corners, near[np.isfinite(near).all(axis=1)]])


def _inside(straight: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns with places (h, w, 2) between two corners (2,)."""
    inside = np.all((straight >= low) & (straight <= high), axis=2)
    return np.flatnonzero(np.any(inside, axis=1)), np.flatnonzero(np.any(inside, axis=0))


def silhouette(camera: Camera, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels whose centres a surface covers, seen alone. vertices (V, 3) [m], triangles (F, 3)."""
    return seen(camera, vertices, triangles).mask


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks (H, W); 0 when both are empty, for nothing seen is no agreement."""
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 0.0


def outlines(mask: np.ndarray) -> list[np.ndarray]:
    """Closed outlines of a mask (H, W), each (n, 1, 2) int32 pixels."""
    return list(cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def dash(
    out: np.ndarray, lines: Sequence[np.ndarray], ink: Sequence[float], pattern: tuple[int, int], width: int = 2
) -> None:
    """Draw strokes of outlines, each (n, 1, 2), with gaps, both of so many pixels as `pattern` says, in place.

    A line of more than one pixel has a dark rim. Nothing is drawn along the sheet's edge, where an outline is cut off.
    """
    stroke, gap = pattern
    lines = [piece for line in lines for piece in inner(line, out.shape[1], out.shape[0])]
    strokes = [line[start : start + stroke] for line in lines for start in range(0, len(line), stroke + gap)]
    if width > 1:
        cv2.polylines(out, strokes, False, (*DARK, OPAQUE), width + 2, cv2.LINE_AA)
    cv2.polylines(out, strokes, False, (*ink, OPAQUE), width, cv2.LINE_AA)


def inner(line: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    """The pieces of an outline (n, 1, 2) that lie inside a sheet, away from its edge."""
    inside = ((line >= NEAR_EDGE) & (line < (width - NEAR_EDGE, height - NEAR_EDGE))).all(axis=(1, 2))
    cuts = np.flatnonzero(np.diff(inside)) + 1
    return [piece for piece, kept in zip(np.split(line, cuts), np.split(inside, cuts), strict=True) if kept[0]]


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


def draw_points(drawn: Overlaid, camera: Camera, points: np.ndarray, where: np.ndarray) -> None:
    """Draw a small dot at each of the points (n, 3) [m] where `where` (H, W) bool is true and no line is; in place."""
    pixels, _ = camera.project(points)
    here = pixels[np.isfinite(pixels).all(axis=1)].round().astype(int)
    here = here[((here >= 0) & (here < (camera.width, camera.height))).all(axis=1)]
    for column, row in here[where[here[:, 1], here[:, 0]] & (drawn.taken[here[:, 1], here[:, 0]] == 0)].tolist():
        cv2.circle(drawn.colour, (column, row), 2, DARK, -1)
        cv2.circle(drawn.colour, (column, row), 1, SEEN, -1)


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


def write_gauge(drawn: Overlaid, camera: Camera, gauge: Gauge, covered: np.ndarray) -> None:
    """Write the gauge's number near the end of its line, in place; nothing when that has no pixel.

    covered (H, W) uint8: above 0 where tools are, which the number leaves in sight if it can.
    """
    (end,), _ = camera.project(np.asarray(gauge.nearest)[None])
    if np.isfinite(end).all():
        column, row = np.clip(end, -1e4, 1e4).round().astype(int).tolist()
        lay(drawn.colour, drawn.taken, [str(gauge)], (column + BESIDE, row), GAUGE, sights=covered)


def write_head(drawn: Overlaid, lines: Sequence[str]) -> None:
    """Write lines at the left of the head, under the letter of a side, in place, even over other lines."""
    free, middle = drawn.taken.copy(), len(drawn.taken) // 2
    free[:HEAD] = free[middle - HEAD // 2 : middle + HEAD // 2] = 1  # letters of sides come there
    before = free.copy()
    lay(drawn.colour, free, lines, (0, HEAD), needed=True)
    drawn.taken[free > before] = 1


def write_doubt(drawn: Overlaid, doubt: str) -> None:
    """Write why an answer may not be relied on at the left of the foot, in place, even over other words."""
    height, width = drawn.taken.shape
    lay(drawn.colour, drawn.taken, doubt_lines(doubt, width), (0, height), FINE, ink_of(WARNING), needed=True)


def doubt_lines(doubt: str, width: int) -> list[str]:
    """A doubt as it is written into a picture of this width [pixel]: its reason, and what follows from it."""
    return [line for part in doubt.split(": ") for line in folded(part, NARROW * width)]

"""What lies under the surface, drawn into the picture in register, and never over the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering import place, rasteriser, shade, vignette
from ..rendering.layer import Layer, vertex_normals
from ..rendering.parallel import load
from ..rendering.rasteriser import Seen, seen
from ..rendering.renderer import Picture
from . import distances, window
from .gauge import Gauge, draw_line, write_gauge
from .hud import FINE, FONT, HEAD, NARROW, ROW, folded, lay, millimetres
from .legend import Entry, Names, legend, place_sheet
from .measured import Measure
from .outlines import blank, box_around, dash, ink_of, joined, key_of, outlines, pieces
from .places import CLEAR, PAD
from .rings import lines_of
from .styles import STYLES, Opening, Style
from .traces import BEFORE, DOTTED, Trace, draw_before, draw_trace
from .window import DARK, FRONT, SHUT, Lines, Roles, overlaid

# What may not be relied on is drawn in amber, and broken, with words in a paler one, so that pixels of the outline are
# the outline's alone.
DOUBTFUL = (0.92, 0.50, 0.05)
WARNING = (1.0, 0.84, 0.5)
SEEN = (255.0, 245.0, 190.0)
"""Ink of points that are seen."""
# Of the outline's brightness: that of the margin round it, which is no place of the surface.
FAINT = 0.75
# Lengths of the strokes and gaps of a doubtful outline, of a margin, and of an outline under closed ground [pixel].
BROKEN, DASHED, HIDDEN = (9, 6), (12, 7), (9, 6)
# Width of the latter [pixel].
BOLD = 2
UNNAMED = Names()
# Width of lines that stand in the silhouette [pixel].
SHORT = 96
# Rows of text by which words of the head may be lower to leave a line in sight.
LOWER = 2
# Shares of the picture's width that lines at the head may have, the first at which they run over no tool.
HEAD_WIDTHS = 0.62, 0.5, 0.4, 0.32, 0.25
# So far the words of a style stay from the number beside the tip [pixel].
APART = 2 * ROW


@dataclass(frozen=True, eq=False)
class Overlaid:
    """A picture with lines and words in it: colour (H, W, 3) uint8, and taken (H, W) uint8, above 0 where they are.

    `named`: whether a legend names the lines.
    """

    colour: np.ndarray
    taken: np.ndarray
    named: bool = False


@dataclass(frozen=True, eq=False)
class Ground:
    """What lies over the silhouette in a box of the picture.

    Parameters
    ----------
    mask, shut
        (h, w) bool: the silhouette, and the ground that nothing shines through.
    words
        What is said of the latter; empty where it is no noticeable share.
    """

    mask: np.ndarray
    shut: np.ndarray
    words: str


def load_kernels(device: str = "cpu") -> None:
    """Load all kernels that draw a picture with its overlay, so that the first does not wait for them."""
    load(device, place, rasteriser, shade, vignette, window, distances)


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
    opening: Opening | None = None,
    covered: np.ndarray | None = None,
    error: float | None = None,
    names: Names = UNNAMED,
) -> Overlaid:
    """The picture with a hidden surface drawn into it. On a card, no depth comes back from it but for a cut.

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
        shaded, and darker the deeper it lies. "fill": besides the outline, a flat tint. "depth": one that is the
        stronger the nearer the surface lies to the ground, with its scale. "rings": lines on the ground along which it
        is equally far from the surface (`rings.py`). "cut": an inset (`cut.py`). "none": nothing but a doubt.
    margin
        One number or (V,) [m]: how uncertain the surface is. Where positive, a dashed second outline runs that far out.
    gauge
        Draws the line from the tip to the hidden surface, and its length in millimetres beside the tip.
    before
        Where the hidden surface was before, as in the scan: a dotted grey outline, with an arrow from there to here and
        the mean motion in millimetres.
    doubt
        Why the surface's place may not be relied on. It is written at the picture's foot, see `doubt_lines`, whatever
        the style. The outline is amber and broken. Nothing is promised: no margin is drawn, and the number beside the
        tip has no error.
    traces
        Outlines of other surfaces, drawn under the hidden one's.
    moved
        Length and error [m] to be written in place of the mean motion, which has none.
    head
        Lines that are written at the picture's head, whatever the style and whatever lies there.
    opening
        The ground that the surface may be seen through; None: any. Under other ground the outline is broken, nothing
        shines through, and the picture says what it lies under where that is a noticeable share.
    covered
        (H, W) bool: what covers the overlay besides the occluders, as a hand or cottonoids in a real picture.
    error
        How far off the surface may be [m], for the words of the styles that measure; None where nobody knows.
    names
        What the lines are called in the legend, which is drawn where there is room.

    Raises
    ------
    ValueError
        An unknown style, or a camera or a mask whose size is not the picture's.
    """
    _check(picture, camera, style, covered)
    shape = camera.height, camera.width
    if style == "none":
        plain = Overlaid(picture.colour.copy(), np.zeros(shape, np.uint8))
        write_head(plain, head)
        write_doubt(plain, doubt)
        return plain
    if doubt:
        hidden, margin, error = replace(hidden, colour=DOUBTFUL), 0.0, None
        gauge = None if gauge is None else replace(gauge, error=None)
    grown = None
    if np.any(np.asarray(margin) > 0.0):
        normals = vertex_normals(hidden.vertices, hidden.triangles)
        grown = replace(hidden, vertices=hidden.vertices + np.reshape(margin, (-1, 1)) * normals)
    roles = Roles(tuple(occluders), None if opening is None else opening.ids, covered)
    measure = Measure(style, picture, camera, hidden, roles, gauge, names.now, error)
    surfaces = [layer.vertices for layer in (hidden, grown, before) if layer is not None]
    surfaces += [trace.layer.vertices for trace in traces]
    box = box_around(camera, np.concatenate([*surfaces, measure.reached]))
    around = box if gauge is None else joined(box, box_around(camera, np.stack([gauge.tip, gauge.nearest])))
    taken, ground = np.zeros(shape, np.uint8), None
    faint, thin = np.zeros(shape, bool), np.zeros(shape, bool)
    if around is None:
        out = picture.colour.copy()
    else:
        part, device = camera.cropped(*around), str(picture.drawn.colour.device)
        found = seen(part, hidden.vertices, hidden.triangles, device=device)
        under, above = blank(part), None
        if before is not None:
            draw_before(under, camera, around, before, hidden)
        if grown is not None:
            bare = under[..., 3] == 0
            wider = seen(part, grown.vertices, grown.triangles, device=device).mask
            dash(under, outlines(wider), margin_ink(hidden), DASHED, 1)
            faint[around] = bare & (under[..., 3] > 0)
        if opening is not None:
            ground = ground_over(picture.segmentation[around], roles.of(picture.segmentation, around), found, opening)
        for trace in traces:
            draw_trace(under, part, trace)
        draw_broken(under, found, ink_of(hidden.colour), ground, doubt)
        if gauge is not None or style == "cut":
            above = blank(part)
        if gauge is not None and above is not None:
            draw_line(above, part, gauge)
        bare = under[..., 3] == 0
        measure.draw(under, under if above is None else above, around)
        if style == "rings":
            thin[around] = lines_of(bare & (under[..., 3] > 0))
        lines = Lines(ink_of(hidden.colour), not doubt, under, above)
        out, taken[around] = overlaid(picture.drawn, around, part, hidden, found, roles, style, lines)
    drawn, lined = Overlaid(out, taken), taken.copy()
    # Head and corner first, so that their words seldom move; then by importance, for some are left out without room.
    write_head(drawn, head)
    if before is not None and box is not None:
        motion = float(np.linalg.norm(hidden.vertices - before.vertices, axis=1).mean())
        said = millimetres(motion) if moved is None else millimetres(*moved)
        firm = taken * ~faint  # it keeps its place, though it stands on the margin's line
        lay(out, firm, folded(f"{names.motion} {said}", NARROW * camera.width), (0, camera.height))
        taken |= firm
    write_doubt(drawn, doubt)
    if gauge is None and opening is None and style not in ("depth", "rings", "cut"):
        return drawn
    whole = roles.of(picture.segmentation)
    front = (whole == FRONT).view(np.uint8)
    apart = np.zeros_like(taken)
    if gauge is not None:
        before_it = taken.copy()
        write_gauge(out, taken, camera, gauge, front, lined, thin)
        # What explains the style is no explanation of the number.
        apart = cv2.dilate(taken & ~before_it, np.ones((2 * APART + 1,) * 2, np.uint8))
    if ground is not None and around is not None:
        write_ground(drawn, around, ground, front, lined)
        sights = (whole != SHUT).view(np.uint8)
        needed = front.copy()
        for each in (sights, needed):
            each[around] |= ground.mask
        measure.lay(out, taken, sights | apart, needed)
        keys = legend_entries(hidden, grown, before, traces, doubt, names)
        return replace(drawn, named=bool(keys) and place_sheet(out, taken, legend(keys), sights))
    measure.lay(out, taken, front, front)
    return drawn


def _check(picture: Picture, camera: Camera, style: str, covered: np.ndarray | None) -> None:
    """Raise ValueError as `composite` does."""
    if style not in STYLES:
        raise ValueError(f"there is no overlay style {style!r}: choose one of {', '.join(STYLES)}.")
    shape = picture.drawn.colour.shape[1:]
    if shape != (camera.height, camera.width):
        raise ValueError(f"the picture is {shape}, the camera {(camera.height, camera.width)}.")
    if covered is not None and (covered.shape != shape or covered.dtype != bool):
        given = f"{covered.shape} of {covered.dtype}"
        raise ValueError(f"covered is {given}: give a mask (H, W) of bool as large as the picture, {shape}.")


def ground_over(segmentation: np.ndarray, role: np.ndarray, found: Seen, opening: Opening) -> Ground:
    """What lies over a surface that is found in a box, whose segmentation and roles (h, w) uint8 are given."""
    mask = found.mask
    counts = np.bincount(segmentation[mask & (role != FRONT)], minlength=256)
    layers = np.flatnonzero(counts).tolist()
    return Ground(mask, role == SHUT, opening.said({layer: int(counts[layer]) for layer in layers}))


def draw_broken(
    sheet: np.ndarray, found: Seen, ink: tuple[float, float, float], ground: Ground | None, doubt: str
) -> None:
    """Draw what of an outline is no solid line, in place: all of a doubtful one, and what closed ground covers."""
    if doubt:
        dash(sheet, outlines(found.mask), ink, BROKEN)
    elif ground is not None and ground.shut.any():
        dash(sheet, pieces(outlines(ground.mask), ground.shut), ink, HIDDEN, BOLD)


def margin_ink(hidden: Layer) -> tuple[float, ...]:
    """The ink of the margin round a surface."""
    return tuple(FAINT * share for share in ink_of(hidden.colour))


def legend_entries(
    hidden: Layer, grown: Layer | None, before: Layer | None, traces: Sequence[Trace], doubt: str, names: Names
) -> tuple[Entry, ...]:
    """The lines that are drawn and have a name."""
    named = zip(traces, names.traces, strict=False)
    entries = [
        Entry(names.now, key_of(ink_of(hidden.colour)), BROKEN if doubt else None, BOLD),
        *([] if grown is None else [Entry(names.margin, margin_ink(hidden), DASHED, 1)]),
        *(Entry(name, key_of(ink_of(trace.layer.colour)), trace.pattern) for trace, name in named),
        *([] if before is None else [Entry(names.before, ink_of(BEFORE), DOTTED)]),
    ]
    return tuple(entry for entry in entries if entry.name)


def draw_points(drawn: Overlaid, camera: Camera, points: np.ndarray, where: np.ndarray) -> None:
    """Draw a small dot at each of the points (n, 3) [m] where `where` (H, W) bool is true and no line is; in place."""
    pixels, _ = camera.project(points)
    here = pixels[np.isfinite(pixels).all(axis=1)].round().astype(int)
    here = here[((here >= 0) & (here < (camera.width, camera.height))).all(axis=1)]
    near = cv2.dilate(drawn.taken, np.ones((7, 7), np.uint8))  # of words, all letters stay whole
    for column, row in here[where[here[:, 1], here[:, 0]] & (near[here[:, 1], here[:, 0]] == 0)].tolist():
        cv2.circle(drawn.colour, (column, row), 2, DARK, -1)
        cv2.circle(drawn.colour, (column, row), 1, SEEN, -1)


def write_ground(
    drawn: Overlaid, box: tuple[slice, slice], ground: Ground, front: np.ndarray, lines_there: np.ndarray
) -> None:
    """Write what the surface lies under, where it does, in place; front and lines (H, W) uint8 as `lay` takes them."""
    if not ground.words:
        return
    there = cv2.moments((ground.mask & ground.shut).view(np.uint8), binaryImage=True)
    lines = ground_lines(ground.words)
    wide = max(cv2.getTextSize(line, FONT, FINE, 1)[0][0] for line in lines)
    column, row = there["m10"] / there["m00"] + box[1].start, there["m01"] / there["m00"] + box[0].start
    wish = round(column - wide / 2), round(row - ROW * len(lines) / 2)
    lay(drawn.colour, drawn.taken, lines, wish, FINE, needed=True, sights=front, lines_there=lines_there)


def ground_lines(words: str) -> list[str]:
    """What is said of the ground as it stands in a picture: short lines, which have room in a silhouette."""
    return folded(words, SHORT)


def head_lines(texts: Sequence[str], tool: np.ndarray) -> list[str]:
    """Lines for the head of a picture, broken no more than it takes to run over no tool (H, W) bool, if they can."""
    width = tool.shape[1]
    tried = [[part for text in texts for part in folded(text, share * width)] for share in HEAD_WIDTHS]
    for lines in tried:
        long = max((cv2.getTextSize(line, FONT, FINE, 1)[0][0] for line in lines), default=0)
        if not tool[HEAD - CLEAR : HEAD + ROW * len(lines) + CLEAR, : PAD + long + CLEAR].any():
            return lines
    return tried[0]


def write_head(drawn: Overlaid, lines: Sequence[str]) -> None:
    """Write lines at the left of the head, under the letter of a side, in place, even over other lines."""
    free, middle, below = drawn.taken.copy(), len(drawn.taken) // 2, HEAD + ROW * (len(lines) + LOWER)
    free[:HEAD] = free[middle - HEAD // 2 : middle + HEAD // 2] = 1  # letters of sides come there
    free[below:] = 1  # rather over a line than in the midst of the picture
    before = free.copy()
    lay(drawn.colour, free, lines, (0, HEAD), needed=True, lines_there=drawn.taken)
    drawn.taken[free > before] = 1


def write_doubt(drawn: Overlaid, doubt: str) -> None:
    """Write why an answer may not be relied on at the left of the foot, in place, even over other words."""
    height, width = drawn.taken.shape
    lay(drawn.colour, drawn.taken, doubt_lines(doubt, width), (0, height), FINE, ink_of(WARNING), needed=True)


def doubt_lines(doubt: str, width: int) -> list[str]:
    """A doubt as it is written into a picture of this width [pixel]: its reason, and what follows from it."""
    return [line for part in doubt.split(": ") for line in folded(part, NARROW * width)]

"""Image sheet of an inspection: three slices, a view of the craniotomy from outside, and the numbers."""

import textwrap
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import KDTree

from ar.page.slices import PLANES
from sim.bodies.head_masks import HeadMasks
from sim.bodies.signed_distance import compute_gradient
from sim.bodies.subject import Subject

from .inspection import Inspection

Colour = tuple[int, int, int]

SIDE = 480  # Side of a panel [pixel].
COLUMN_WIDTH = 500  # Width of the column of text [pixel].
LINE_SPACING = 22  # Line spacing of the text [pixel].
FONT_SIZE = 16  # Size of the letters [pixel].
PAD = 14  # Margin of text and scale bar [pixel].
MAX_LINE_LENGTH = 58  # Maximum number of letters in a line of text.
GROUND_COLOUR, TEXT_COLOUR, FAINT_COLOUR, WARNING_COLOUR = (
    (12, 12, 14),
    (238, 238, 232),
    (160, 160, 156),
    (255, 196, 92),
)  # Colours (RGB).
BRAIN: Colour = (104, 116, 138)  # Colour of the brain (RGB).
COLOURS: dict[str, Colour] = {
    "brain": BRAIN,
    "ventricles": (66, 132, 214),
    "oedema": (222, 178, 72),
    "falx": (236, 236, 226),
    "tentorium": (236, 236, 226),
    "tumour": (214, 62, 62),
    "necrosis": (122, 28, 58),
    "left out": (206, 92, 206),
    "opening": (70, 205, 110),
}
"""Colour (RGB) of each part; later parts are drawn over earlier parts."""
CORTEX: Colour = (176, 168, 164)  # Colour of the covered cortex (RGB).
VIEW_MARGIN = 6e-3  # Margin of a view round the brain [m].
HALF_LINE_WIDTH = 2.2e-3  # Half the thickness of the craniotomy's line in a slice [m].
TINT_OPACITY = 0.6  # Opacity of colours over a scan.
SHADOW_OPACITY = 0.45  # Opacity of the tumour's colour over the cortex that hides it.
SIDES = ("LR", "PA", "IS")  # Letters of the negative and positive direction of each RAS axis.
LIGHT = np.array([-0.4, 0.5, 0.77])  # Direction of the light on the cortex: from the viewer's upper left.


@dataclass(frozen=True)
class InspectionView:
    """View of a plane in space, as a square image.

    Parameters
    ----------
    name
        Name of the view.
    right, down
        Unit vectors (3,) along the image's columns and rows.
    middle
        Position (3,) [m] of the image's centre.
    reach
        Half of the image's side length [m].
    """

    name: str
    right: np.ndarray
    down: np.ndarray
    middle: np.ndarray
    reach: float

    def compute_points(self) -> np.ndarray:
        """Compute the positions (SIDE, SIDE, 3) [m] of the pixels."""
        steps = self.reach * ((2.0 * np.arange(SIDE) + 1.0) / SIDE - 1.0)
        return self.middle + steps[:, None, None] * self.down + steps[None, :, None] * self.right

    def find_orientation_letters(self) -> dict[str, str]:
        """Return the orientation letters (R, L, A, P, S, I) at the edges "left", "right", "top" and "bottom"."""
        found = {}
        for edge, direction in (
            ("left", -self.right),
            ("right", self.right),
            ("top", -self.down),
            ("bottom", self.down),
        ):
            axis = int(np.abs(direction).argmax())
            found[edge] = SIDES[axis][int(direction[axis] > 0.0)]
        return found


def draw_sheet(inspection: Inspection, masks: HeadMasks, subject: Subject, open_mask: np.ndarray) -> np.ndarray:
    """Draw the sheet of an inspection as an image (H, W, 3) uint8.

    `open_mask` (n,) bool is True for points of the subject's cortex inside the craniotomy.
    """
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    centre = subject.pieces[0].centre
    panels, drawn = [], {"opening"}
    for plane in PLANES:
        right, down = np.array(plane.right), np.array(plane.down)
        across = np.abs(right) + np.abs(down)
        reach = 0.5 * float(((high - low) * across).max()) + VIEW_MARGIN
        middle = 0.5 * (low + high) * across + centre * (1.0 - across)
        view = InspectionView(f"{plane.name}, through the tumour", right, down, middle, reach)
        colour, names = _slice(view, masks, subject, open_mask)
        panels.append(_annotate_view(colour, view))
        drawn |= names
    panels.append(_draw_cortex(masks, subject, open_mask))
    picture = Image.new("RGB", (2 * SIDE + COLUMN_WIDTH, 2 * SIDE), GROUND_COLOUR)
    for number, panel in enumerate(panels):
        picture.paste(Image.fromarray(panel), (SIDE * (number % 2), SIDE * (number // 2)))
    _write_text(ImageDraw.Draw(picture), inspection, [name for name in COLOURS if name in drawn])
    return np.asarray(picture)


def _slice(view: InspectionView, masks: HeadMasks, subject: Subject, opened: np.ndarray) -> tuple[np.ndarray, set[str]]:
    """Return the image of a slice with coloured labels over the scan and the opened cortex, and the drawn labels."""
    points = view.compute_points().reshape(-1, 3)
    inverse = np.linalg.inv(masks.affine)
    index = np.rint(points @ inverse[:3, :3].T + inverse[:3, 3]).astype(int)
    there = ((index >= 0) & (index < masks.brain.shape)).all(axis=1)

    def sample_mask(mask: np.ndarray) -> np.ndarray:
        found = np.zeros(len(points), bool)
        found[there] = mask[tuple(index[there].T)]
        return found

    solid, kept = subject.brain(points), subject.tumour(points)
    tumour = sample_mask(masks.tumour)
    voxel = float(np.linalg.norm(masks.affine[:3, :3], axis=0).max())
    layers = {
        "brain": solid < 0.0,
        **{name: sample_mask(mask) for name, mask in masks.parts.items() if name != "necrosis"},
        "tumour": tumour,
        **{name: sample_mask(mask) & tumour for name, mask in masks.parts.items() if name == "necrosis"},
        "left out": tumour & ((kept > voxel) | (solid > voxel)),
    }
    colour = np.tile(np.array(GROUND_COLOUR, float), (len(points), 1))
    tint = 1.0
    if subject.intensity is not None:
        grey = subject.intensity.interpolate(points)
        white = np.quantile(grey[layers["brain"]], 0.98) if layers["brain"].any() else grey.max()
        colour = np.repeat(np.clip(grey / (white or 1.0), 0.0, 1.0)[:, None] * 235.0, 3, axis=1)
        tint = TINT_OPACITY
    drawn = {name for name, mask in layers.items() if mask.any() and (name != "brain" or subject.intensity is None)}
    for name, mask in layers.items():
        if name in drawn:
            colour[mask] = _blend_colour(colour[mask], COLOURS[name], tint)
    rind = np.flatnonzero(np.abs(solid) < HALF_LINE_WIDTH)
    if len(rind) and opened.any():
        apart = np.linalg.norm(points[rind, None] - subject.site, axis=2)[:, 0]
        near = rind[apart < np.linalg.norm(subject.cortex[opened] - subject.site, axis=1).max() + HALF_LINE_WIDTH]
        colour[near[opened[KDTree(subject.cortex).query(points[near])[1]]]] = COLOURS["opening"]
    return np.rint(colour).astype(np.uint8).reshape(SIDE, SIDE, 3), drawn


def _blend_colour(background: np.ndarray, colour: Colour, opacity: float) -> np.ndarray:
    """Blend colours (..., 3) with a share (0 to 1) of another colour."""
    return (1.0 - opacity) * background + opacity * np.array(colour)


def _draw_cortex(masks: HeadMasks, subject: Subject, opened: np.ndarray) -> np.ndarray:
    """Render the cortex seen along the normal of the craniotomy, with the silhouette of the tumour below."""
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    inward = 0.5 * (low + high) - subject.site
    if opened.sum() > 3:  # normal to the plane of the opening
        normal = np.linalg.svd(subject.cortex[opened] - subject.cortex[opened].mean(axis=0), full_matrices=False)[2][2]
        inward = normal if normal @ inward > 0.0 else -normal
    inward = inward / np.linalg.norm(inward)
    up = np.array([0.0, 0.0, 1.0]) if abs(inward[2]) < 0.8 else np.array([0.0, 1.0, 0.0])
    down = -(up - (up @ inward) * inward)
    down /= np.linalg.norm(down)
    right = np.cross(down, inward)
    across = subject.cortex - subject.site
    reach = float(np.abs(np.stack([across @ right, across @ down])).max(axis=1).mean()) * 0.8
    view = InspectionView("from outside", right, down, subject.site, reach)
    cell = max(2.0 * reach / SIDE, 1.5 * float(np.linalg.norm(masks.affine[:3, :3], axis=0).max()))
    seen = _rasterise_points(view, subject.cortex, inward, cell)
    colour = np.tile(np.array(GROUND_COLOUR, float), (SIDE, SIDE, 1))
    there = seen >= 0
    places = subject.cortex[seen[there]]
    normals = compute_gradient(subject.brain, places, probe=cell)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    light = np.clip(normals @ np.stack([right, -down, -inward], axis=1) @ LIGHT, 0.0, 1.0)
    base = np.where(opened[seen[there]][:, None], COLOURS["opening"], CORTEX)
    colour[there] = base * (0.3 + 0.7 * light)[:, None]
    shadow = _rasterise_points(view, subject.interface, inward, cell) >= 0
    colour[shadow] = _blend_colour(colour[shadow], COLOURS["tumour"], SHADOW_OPACITY)
    return _annotate_view(np.rint(colour).astype(np.uint8), view)


def _rasterise_points(view: InspectionView, points: np.ndarray, inward: np.ndarray, cell: float) -> np.ndarray:
    """Return the index (SIDE, SIDE) of the nearest point (n, 3) in each pixel, or -1; a point is `cell` [m] wide."""
    off, scale = points - view.middle, 0.5 * SIDE / view.reach
    half = int(np.ceil(0.5 * cell * scale))
    order = np.argsort(-(off @ inward), kind="stable")  # the nearest point is painted last
    at = np.rint(np.stack([off @ view.down, off @ view.right], axis=1)[order] * scale + 0.5 * SIDE).astype(int)
    square = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(1, -1, 2)
    index = (at[:, None] + square).reshape(-1, 2)
    number = np.repeat(order, square.shape[1])
    inside = ((index >= 0) & (index < SIDE)).all(axis=1)
    seen = np.full((SIDE, SIDE), -1)
    seen[tuple(index[inside].T)] = number[inside]
    return seen


def _annotate_view(colour: np.ndarray, view: InspectionView) -> np.ndarray:
    """Return the image of a view with its name, orientation letters and a scale bar."""
    picture = Image.fromarray(colour)
    ink = ImageDraw.Draw(picture)
    ink.rectangle([0, 0, SIDE - 1, SIDE - 1], outline=(60, 60, 64))
    font = ImageFont.load_default(FONT_SIZE)
    letters = view.find_orientation_letters()
    half = SIDE // 2
    for edge, at, anchor in (
        ("left", (8, half), "lm"), ("right", (SIDE - 8, half), "rm"),
        ("top", (half, 6), "ma"), ("bottom", (half, SIDE - 6), "md"),
    ):  # fmt: skip
        ink.text(
            at,
            letters[edge],
            TEXT_COLOUR,
            ImageFont.load_default(FONT_SIZE + 4),
            anchor,
            stroke_width=2,
            stroke_fill=GROUND_COLOUR,
        )
    ink.text((8, 6), view.name, TEXT_COLOUR, font, stroke_width=2, stroke_fill=GROUND_COLOUR)
    bar = 0.5 * SIDE * 0.02 / view.reach
    ink.line([PAD, SIDE - PAD, PAD + bar, SIDE - PAD], TEXT_COLOUR, 3)
    ink.text((PAD, SIDE - PAD - 6), "20 mm", TEXT_COLOUR, font, "ld", stroke_width=2, stroke_fill=GROUND_COLOUR)
    return np.asarray(picture)


def _write_text(canvas: ImageDraw.ImageDraw, inspection: Inspection, labels: list[str]) -> None:
    """Draw the numbers, the warnings and the colour legend into the right column of the sheet."""
    left, top = 2 * SIDE + PAD, PAD
    rows: list[tuple[str, Colour]] = [("Model to be built", TEXT_COLOUR)]
    for text in inspection.format_lines():
        rows += [(part, TEXT_COLOUR) for part in textwrap.wrap(text, MAX_LINE_LENGTH, subsequent_indent="    ")]
    rows += [
        ("", TEXT_COLOUR),
        ("Warnings" if inspection.warnings else "No warnings", WARNING_COLOUR if inspection.warnings else TEXT_COLOUR),
    ]
    for text in inspection.warnings:
        rows += [(part, WARNING_COLOUR) for part in textwrap.wrap(f"- {text}", MAX_LINE_LENGTH, subsequent_indent="  ")]
    rows += [("", TEXT_COLOUR), ("Research only; not a medical device.", FAINT_COLOUR)]
    for number, (text, colour) in enumerate(rows):
        canvas.text((left, top + LINE_SPACING * number), text, colour, ImageFont.load_default(FONT_SIZE))
    legend = [("tumour that is left out" if name == "left out" else name, [COLOURS[name]]) for name in labels]
    grounds = np.array([COLOURS["opening"], CORTEX])
    legend.append(
        (
            "tumour under the opening, and under the skull",
            _blend_colour(grounds, COLOURS["tumour"], SHADOW_OPACITY).tolist(),
        )
    )
    for number, (label, colours) in enumerate(reversed(legend)):
        row = 2 * SIDE - PAD - LINE_SPACING * (number + 1)
        for part, colour in enumerate(colours):
            wide = 16 // len(colours)
            at = left + wide * part
            canvas.rectangle([at, row + 3, at + wide - 1, row + 18], fill=tuple(int(value) for value in colour))
        canvas.text((left + 24, row), label, TEXT_COLOUR, ImageFont.load_default(FONT_SIZE))

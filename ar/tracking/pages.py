"""A4 pages for printing the targets at exact size, and a description of the targets for other programs."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from .targets import (
    BORDER_WIDTH,
    MARKER_DICTIONARY,
    MARKER_RATIO,
    TIP_DISTANCE,
    Face,
    Target,
    build_tool_cube,
    list_targets,
)

PER_MM = 20  # Resolution of a page [pixel/mm]: each module of each marker takes a whole number of pixels.
DPI = 25.4 * PER_MM  # Resolution of a page [pixel/inch].
A4 = (210.0, 297.0)  # Width and height of the page [mm].
RULER_LENGTH = 100.0  # Length of the printed rulers [mm].
PROGRAM_NAME = "sulcus markers"
"""Program name in the metadata of PDF and PNG."""
LINE_WIDTH = 0.2  # Line width [mm].
TEXT_HEIGHT = 3.4  # Height of the text [mm].
TITLE_HEIGHT = 6.0  # Height of titles [mm].
NAME_HEIGHT = 2.6  # Height of the names of faces [mm].
LINE_SPACING = 4.8
"""Line spacing of text [mm]."""
PRINT_INSTRUCTIONS = (  # Instructions on each page.
    "Print at 100 % on A4 ('actual size', not 'fit to page'), then measure both rulers.",
    f"If a ruler is not {RULER_LENGTH:.0f} mm long to 0.2 mm, do not use this page: correct the scale, and print it "
    "again.",
)


@dataclass(frozen=True, eq=False)
class PlacedFace:
    """Face of a target at its position on a page.

    Parameters
    ----------
    face
        Face to print.
    left, top
        Distances [mm] of the face's left and upper side (border excluded) from the page's upper left corner.
    quarter_turns
        Number of clockwise quarter turns of the face.
    """

    face: Face
    left: float
    top: float
    quarter_turns: int = 0


@dataclass(frozen=True, eq=False)
class PrintedPage:
    """Page to print, with the faces of one target.

    Parameters
    ----------
    name
        Name of the page's target.
    pixels
        Image (H, W) uint8 with values 0 or 255, `PER_MM` pixels per millimetre.
    faces
        Faces on the page.
    """

    name: str
    pixels: np.ndarray
    faces: tuple[PlacedFace, ...]


def build_printed_pages() -> tuple[PrintedPage, ...]:
    """Draw the pages of the tool's cube, the patient's reference and the calibration board; return all three."""
    cube, plate, board = list_targets()
    return _draw_cube_page(cube), _draw_plate_page(plate), _draw_board_page(board)


def to_face_name(face: Face) -> str:
    """Return the target's axis along a face's outward normal, such as "+x" or "-z"."""
    outwards = -face.T_target_face[:3, 2]
    axis = int(np.abs(outwards).argmax())
    return f"{'+' if outwards[axis] > 0.0 else '-'}{'xyz'[axis]}"


def to_png(page: PrintedPage) -> bytes:
    """Encode a page as a PNG with one bit per pixel and its resolution."""
    said = PngInfo()
    said.add_text("Source", PROGRAM_NAME)
    return _encode_pages([page], "PNG", dpi=(DPI, DPI), pnginfo=said)


def to_pdf(pages: Sequence[PrintedPage]) -> bytes:
    """Encode pages as one PDF file, each at the size of its paper."""
    return _encode_pages(pages, "PDF", resolution=DPI, creator=PROGRAM_NAME, title="Targets of sulcus")


def get_dictionary_name() -> str:
    """Return OpenCV's name of the marker dictionary."""
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    return next(name for name in names if getattr(cv2.aruco, name) == MARKER_DICTIONARY)


def describe_targets() -> dict:
    """Return a description of all targets for JSON, in millimetres: sizes, markers, and corners in the target's frame.

    Corners are the inner chessboard corners in OpenCV's order, row by row as seen from the front. The outline is that
    of the chessboard, clockwise from the upper left corner.
    """
    return {
        "format": "sulcus targets 1",
        "unit": "mm",
        "dictionary": get_dictionary_name(),
        "targets": [
            {"name": target.name, "faces": [_describe_face(face) for face in target.faces]} for target in list_targets()
        ],
        "nominal_tip_mm": {build_tool_cube().name: [0.0, 0.0, _to_millimetres(-TIP_DISTANCE)]},
    }


def _describe_face(face: Face) -> dict:
    return {
        "name": to_face_name(face),
        "columns": face.columns,
        "rows": face.rows,
        "square_mm": _to_millimetres(face.square),
        "marker_mm": _to_millimetres(MARKER_RATIO * face.square),
        "ids": face.ids.tolist(),
        "outline_mm": _to_millimetres(face.outline),
        "corners_mm": _to_millimetres(face.corners),
    }


def _to_millimetres(metres: float | np.ndarray):
    """Convert metres to millimetres, rounded to the nanometre; return a float or lists of floats."""
    return (np.round(1e3 * np.asarray(metres), 6) + 0.0).tolist()


def _draw_cube_page(target: Target) -> PrintedPage:
    """Draw the three faces as a net that folds to a corner of the cube: +z above +x, and +y to the right of +x."""
    along_x, along_y, along_z = target.faces
    wide, border = _to_millimetres(along_x.size[0] + 2.0 * BORDER_WIDTH), _to_millimetres(BORDER_WIDTH)
    left, top = 57.0, 118.0
    cells = ((along_z, left, top, 1), (along_x, left, top + wide, 0), (along_y, left + wide, top + wide, 0))
    page, ink = _create_page(A4)
    placed = tuple(PlacedFace(face, x + border, y + border, turns) for face, x, y, turns in cells)
    for each, (face, x, y, _) in zip(placed, cells, strict=True):
        _paste_face(page, each)
        _write_text(ink, to_face_name(face), x + 0.8, y + 0.4, NAME_HEIGHT)
    right, below, flap = left + wide, top + wide, 10.0
    folds = [((left, below), (right, below)), ((right, below), (right, below + wide)), ((right, top), (right, below))]
    for start, end in folds:
        _draw_line(ink, start, end, 1.0)
    tab = [(right, top), (right + flap, top + flap), (right + flap, below - flap), (right, below - 1.0)]
    around = [*tab, (right, below), (right + wide, below), (right + wide, below + wide), (left, below + wide)]
    for start, end in zip([*around, (left, top)], [*around[1:], (left, top), (right, top)], strict=True):
        _draw_line(ink, start, end, 3.0)
    _write_text(ink, "tab", right + 2.5, top + 0.5 * wide - 2.0, TEXT_HEIGHT)
    said = (
        f"A cube of {wide:.0f} mm with three faces along +x, +y and +z; their names stand in their borders.",
        *_describe_sizes(target),
        *PRINT_INSTRUCTIONS,
        "Cut along the long dashes. Fold backwards along the short dashes: three faces meet at one corner.",
        f"Glue the paper onto a stiff cube of {wide:.0f} mm, and the tab behind the upper border of +y.",
        "Or cut the faces apart and glue each alone. Sides that touch here must touch on the cube,",
        "and so must the upper side of +y and the side with the tab.",
        "The shaft leaves the cube through the middle of the face opposite +z, at a right angle.",
        f"The tool's tip is nominally {_to_millimetres(TIP_DISTANCE):.0f} mm from the middle of the cube, before "
        "calibration.",
    )
    return _compose_page(target, page, ink, placed, said, ((20.0, top), (55.0, top + 2.0 * wide + 20.0)))


def _draw_plate_page(target: Target) -> PrintedPage:
    """Draw the page of the patient's reference: one face with its border, to cut out."""
    (face,) = target.faces
    wide, border = _to_millimetres(face.size[0] + 2.0 * BORDER_WIDTH), _to_millimetres(BORDER_WIDTH)
    left, top = 0.5 * (A4[0] - wide), 110.0
    page, ink = _create_page(A4)
    placed = PlacedFace(face, left + border, top + border)
    _paste_face(page, placed)
    corners = [(left, top), (left + wide, top), (left + wide, top + wide), (left, top + wide)]
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        _draw_line(ink, start, end, 3.0)
    said = (
        f"A plate of {_to_millimetres(face.size[0]):.0f} mm, {wide:.0f} mm with its border.",
        *_describe_sizes(target),
        *PRINT_INSTRUCTIONS,
        "Cut along the dashes, and glue the paper onto a stiff, flat plate.",
        "Fix the plate next to the craniotomy, so that it cannot move against the skull.",
        "Its frame has its origin in the upper left corner of the squares: x right, y down, z into the plate.",
    )
    return _compose_page(target, page, ink, (placed,), said, ((20.0, top), (55.0, top + wide + 50.0)))


def _draw_board_page(target: Target) -> PrintedPage:
    """Draw the page of the calibration board in landscape format, without cutting lines."""
    (face,) = target.faces
    page, ink = _create_page((A4[1], A4[0]))
    placed = PlacedFace(face, 0.5 * (A4[1] - _to_millimetres(face.size[0])) + 20.0, 7.0)
    _paste_face(page, placed)
    said = (*_describe_sizes(target), *PRINT_INSTRUCTIONS)
    _write_text(ink, f"sulcus: {target.name}", 15.0, 176.0, TITLE_HEIGHT)
    _write_text(ink, "Glue it onto a stiff, flat plate: a bent board calibrates wrongly.", 60.5, 178.5, TEXT_HEIGHT)
    _write_paragraph(ink, said, 15.0, 183.0)
    _draw_ruler(ink, 15.0, 40.0, is_vertical=True)
    _draw_ruler(ink, 180.0, 192.0, is_vertical=False)
    return PrintedPage(target.name, _read_pixels(page), (placed,))


def _compose_page(
    target: Target, page: Image.Image, canvas: ImageDraw.ImageDraw, faces: tuple[PlacedFace, ...], lines: Sequence[str],
    rulers: tuple[tuple[float, float], tuple[float, float]],
) -> PrintedPage:  # fmt: skip
    """Complete a portrait page: add the title, the text and two rulers, which start at the positions `rulers` [mm]."""
    _write_text(canvas, f"sulcus: {target.name}", 15.0, 14.0, TITLE_HEIGHT)
    _write_paragraph(canvas, lines, 15.0, 25.0)
    _draw_ruler(canvas, *rulers[0], is_vertical=True)
    _draw_ruler(canvas, *rulers[1], is_vertical=False)
    return PrintedPage(target.name, _read_pixels(page), faces)


def _describe_sizes(target: Target) -> tuple[str, str]:
    """Describe the sizes of the squares and the numbers of the markers of a target, in two lines."""
    face, ids = target.faces[0], np.concatenate([each.ids for each in target.faces])
    return (
        f"Each face has {face.columns} x {face.rows} squares of {_to_millimetres(face.square):g} mm, "
        f"and markers of {_to_millimetres(MARKER_RATIO * face.square):g} mm.",
        f"The markers are numbers {ids.min()} to {ids.max()} of OpenCV's {get_dictionary_name()}.",
    )


def _create_page(size: tuple[float, float]) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Create a white page of (width, height) [mm]; return it and the object that draws on it."""
    page = Image.new("1", (_to_pixels(size[0]), _to_pixels(size[1])), 1)
    return page, ImageDraw.Draw(page)


def _paste_face(page: Image.Image, face: PlacedFace) -> None:
    picture = np.rot90(face.face.draw(_to_pixels(_to_millimetres(face.face.square))), -face.quarter_turns)
    page.paste(Image.fromarray(np.ascontiguousarray(picture)), (_to_pixels(face.left), _to_pixels(face.top)))


def _write_text(canvas: ImageDraw.ImageDraw, text: str, left: float, top: float, size: float) -> None:
    canvas.text((_to_pixels(left), _to_pixels(top)), text, fill=0, font=ImageFont.load_default(_to_pixels(size)))


def _write_paragraph(canvas: ImageDraw.ImageDraw, lines: Sequence[str], left: float, top: float) -> None:
    for number, line in enumerate(lines):
        _write_text(canvas, line, left, top + LINE_SPACING * number, TEXT_HEIGHT)


def _draw_line(
    canvas: ImageDraw.ImageDraw, start: tuple[float, float], end: tuple[float, float], dash: float = 0.0
) -> None:
    """Draw a line between two positions [mm]; `dash` is the length [mm] of dashes and gaps, 0 for a solid line."""
    start_, end_ = np.array(start), np.array(end)
    pieces = max(2 * round(np.hypot(*(end_ - start_)) / (2.0 * dash)) + 1, 1) if dash else 1
    at = start_ + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (end_ - start_)
    for one, other in zip(at[:-1:2], at[1::2], strict=True):
        canvas.line([*map(_to_pixels, one), *map(_to_pixels, other)], fill=0, width=_to_pixels(LINE_WIDTH))


def _draw_ruler(canvas: ImageDraw.ImageDraw, left: float, top: float, is_vertical: bool) -> None:
    """Draw a ruler with a mark every 10 mm, from a position downwards or to the right."""
    along, across = (
        (np.array([0.0, 1.0]), np.array([1.0, 0.0])) if is_vertical else (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    )
    origin = np.array([left, top])
    _draw_bar(canvas, origin, origin + RULER_LENGTH * along)
    for at in np.arange(0.0, RULER_LENGTH + 1.0, 10.0):
        ends = at in (0.0, 0.5 * RULER_LENGTH, RULER_LENGTH)
        mark = origin + at * along
        _draw_bar(canvas, mark, mark + (5.0 if ends else 3.0) * across)
        if ends:
            x, y = mark + (6.0 * across - 1.8 * along if is_vertical else 5.5 * across - 1.0 * along)
            _write_text(canvas, f"{at:.0f}" if at < RULER_LENGTH else f"{at:.0f} mm", x, y, TEXT_HEIGHT)


def _draw_bar(canvas: ImageDraw.ImageDraw, start: np.ndarray, end: np.ndarray) -> None:
    """Draw a line parallel to a page side, centred exactly, as `LINE_WIDTH` is a multiple of two pixels."""
    half = _to_pixels(LINE_WIDTH) // 2
    low, high = np.minimum(start, end), np.maximum(start, end)
    canvas.rectangle([*(_to_pixels(at) - half for at in low), *(_to_pixels(at) + half - 1 for at in high)], fill=0)


def _to_pixels(mm: float) -> int:
    return round(mm * PER_MM)


def _read_pixels(page: Image.Image) -> np.ndarray:
    return np.asarray(page.convert("L"))


def _encode_pages(pages: Sequence[PrintedPage], file_format: str, **settings: object) -> bytes:
    """Encode one page as an image file, or several pages in one file, with Pillow."""
    first, *others = [Image.fromarray(page.pixels).convert("1", dither=Image.Dither.NONE) for page in pages]
    more = {"save_all": True, "append_images": others} if others else {}
    file = io.BytesIO()
    first.save(file, file_format, **more, **settings)
    return file.getvalue()

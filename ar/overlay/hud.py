"""Text in an image: labels next to objects, and text panels in a corner."""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from .text_placement import BORDER_DISTANCE, find_free_position

Corner = Literal["top left", "top right", "bottom left", "bottom right"]
FONT = cv2.FONT_HERSHEY_SIMPLEX  # OpenCV font of all text in images.
WHITE = (244, 244, 240)  # Default text colour (RGB).
TEXT_SCALE = 0.45  # Default font scale of text in images.
LINE_SPACING = 18  # Line spacing of text [pixel].
MAX_BOTTOM_WIDTH = 0.25  # Largest width of text at the bottom of the image, as a share of the image width.
MAX_TEXT_SHIFT = 48  # Distance from the desired position beyond which text covers thin lines instead [pixel].
# Widths of a panel's lines as shares of the image width; the first that fits is used.
PANEL_WIDTHS = (0.9, 0.5, 0.36, 0.27, 0.2)
RETRY_SCALE = 0.85  # Factor on the font scale of a panel in the second try.
HEAD_ROW = 34  # Top row of the text at the top, below the orientation letter [pixel].
LETTER_SCALE = 0.6  # Font scale of the orientation letters.
SIDES = ("RL", "AP", "SI")  # Orientation letters of the positive and negative direction of each RAS axis.
MIN_OBLIQUE = 0.38  # Smallest component of a unit direction for which a second letter is shown.
# Allowed line breaks: not after a colon, nor between a name, its number, the number's error and the unit.
BREAK_PATTERN = re.compile(
    r"\s+(?!(?:moved |reads )?[-+]?\d|\(\d\.|\+- )(?<![:-] )(?<!\d (?=%))(?<!\d (?=(?:mm|s|ms|N|kPa|ml|points)\b))"
)


def write_text(
    image: np.ndarray, text: str, position: tuple[int, int], scale: float = 0.5, colour: Sequence[float] = WHITE
) -> None:
    """Write a line of ASCII text into an image (H, W, 3) uint8, in place; its baseline starts at (column, row).

    A dark halo keeps the text legible on any background; the line is moved if necessary to be inside the image.
    """
    (width, above), below = cv2.getTextSize(text, FONT, scale, 1)
    column = min(max(position[0], 2), max(image.shape[1] - width - 3, 2))
    row = min(max(position[1], above + 2), max(image.shape[0] - below - 2, above + 2))
    box = slice(max(row - above - 4, 0), row + below + 5), slice(max(column - 4, 0), column + width + 5)
    halo = np.zeros(image[box].shape[:2], np.uint8)
    cv2.putText(halo, text, (column - box[1].start, row - box[0].start), FONT, scale, (200,), 1, cv2.LINE_AA)
    halo = cv2.dilate(halo, np.ones((3, 3), np.uint8))[..., None] / 255.0
    image[box] = image[box] * (1.0 - halo) + 12.0 * halo
    cv2.putText(image, text, (column, row), FONT, scale, tuple(colour), 1, cv2.LINE_AA)


def write_text_with_halo(
    canvas: np.ndarray, text: str, position: tuple[int, int], scale: float, colour: Sequence[float] = WHITE
) -> None:
    """Write a line of ASCII text with a dark halo, in place; its baseline starts at (column, row).

    `canvas` is an image (h, w, 3) uint8, or (h, w, 4) uint8 with premultiplied colour and coverage.
    """
    (width, above), below = cv2.getTextSize(text, FONT, scale, 1)
    column, row = position
    box = np.s_[max(row - above - 4, 0) : row + below + 5, max(column - 4, 0) : column + width + 5]
    halo = np.zeros(canvas.shape[:2], np.uint8)
    cv2.putText(halo, text, position, FONT, scale, (255, 0, 0, 0), 1, cv2.LINE_AA)
    share = cv2.dilate(halo[box], np.ones((3, 3), np.uint8))[..., None] / 255.0
    canvas[box] = canvas[box] * (1.0 - share) + share * np.array([10.0, 12.0, 12.0, 255.0])[: canvas.shape[2]]
    cv2.putText(canvas, text, position, FONT, scale, (*colour, 255.0), 1, cv2.LINE_AA)


@dataclass(frozen=True, eq=False)
class Hideable:
    """Parts of an image that text may cover if there is no better position.

    Parameters
    ----------
    objects
        Mask (H, W) uint8 of objects that should stay visible, such as tools; text covers them only if necessary.
    lines
        Mask (H, W) uint8 of lines, which text covers if it is placed with `force`.
    ring_lines
        Mask (H, W) bool of lines that text covers if it would otherwise be beyond `MAX_TEXT_SHIFT` from its position.
    """

    objects: np.ndarray | None = None
    lines: np.ndarray | None = None
    ring_lines: np.ndarray | None = None


COVER_NOTHING = Hideable()  # Default: text may cover no part of the image.


def place_text(
    image: np.ndarray, occupied: np.ndarray, lines: Sequence[str], position: tuple[int, int],
    scale: float = TEXT_SCALE, colour: Sequence[float] = WHITE, force: bool = False, parts: Hideable = COVER_NOTHING,
) -> None:  # fmt: skip
    """Write lines of ASCII text at the free position closest to `position`, and mark them in `occupied`, in place.

    Place the most important text first: without free space, nothing is written unless `force`.

    Parameters
    ----------
    image, occupied
        Image (H, W, 3) uint8, and mask (H, W) uint8 of lines and text.
    position
        Desired column and row of the upper left corner of the lines, as in `find_free_position`.
    parts
        Parts of the image that the text may cover.
    """
    if not lines:
        return
    sizes = [cv2.getTextSize(line, FONT, scale, 1) for line in lines]
    above, under = sizes[0][0][1], sizes[0][1]
    size = max(width for (width, _), _ in sizes), above + under + LINE_SPACING * (len(lines) - 1)
    sights, thin = parts.objects, parts.ring_lines
    place = None if sights is None else find_free_position(occupied | sights, size, position)
    place = place or find_free_position(occupied, size, position)
    if thin is not None and (
        place is None or np.hypot(place[0] - position[0], place[1] - position[1]) > MAX_TEXT_SHIFT
    ):
        shut = occupied * ~thin
        place = find_free_position(shut if sights is None else shut | sights, size, position) or place
    if place is None and force and parts.lines is not None:
        place = find_free_position(occupied & (1 - parts.lines), size, position)
    if place is None and force:
        place = find_free_position(np.zeros_like(occupied), size, position) or (BORDER_DISTANCE, BORDER_DISTANCE)
    if place is None:
        return
    column, row = place
    for number, line in enumerate(lines):
        write_text(image, line, (column, row + above + number * LINE_SPACING), scale, colour)
    occupied[row : row + size[1], column : column + size[0]] = 1


def wrap_line(text: str, max_width: float, scale: float = TEXT_SCALE) -> list[str]:
    """Break text at allowed breaks into the fewest lines that fit `max_width` [pixel], of about equal width.

    A number stays on one line with its name, error and unit, even if this line becomes too wide.
    """
    return list(_wrap_line(text, max_width, scale))


@lru_cache(maxsize=256)  # most texts recur in the next image, and a call takes 1 ms
def _wrap_line(text: str, max_width: float, scale: float) -> list[str]:
    if _measure_width(text, scale) <= max_width:
        return [text] if text else []
    lines = _break_lines(text, max_width, scale)
    for narrower in range(int(max_width), 0, -BORDER_DISTANCE):
        tried = _break_lines(text, narrower, scale)
        if len(tried) > len(lines):
            break
        lines = tried
    return lines


def _break_lines(text: str, max_width: float, scale: float) -> list[str]:
    lines: list[str] = []
    for word in BREAK_PATTERN.split(text.strip()):
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _measure_width(longer, scale) <= max_width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


@lru_cache(maxsize=1024)  # the same beginnings of lines are tried at many widths
def _measure_width(text: str, scale: float) -> int:
    return cv2.getTextSize(text, FONT, scale, 1)[0][0]


def format_millimetres(length: float, error: float | None = None) -> str:
    """Format a length [m] in millimetres, with its error bound [m], rounded up, if it is finite."""
    if error is None or not math.isfinite(error):
        return f"{1e3 * length:.1f} mm"
    return f"{1e3 * length:.1f} +- {format_bound(error, 1)}"


def format_bound(bound: float, digits: int) -> str:
    """Format a bound [m] in millimetres, rounded up to `digits` decimals and never zero."""
    return f"{max(round_up(1e3 * bound, digits), 10.0**-digits):.{digits}f} mm"


def round_up(value: float, digits: int) -> float:
    """Round a value up to `digits` decimals, because a bound must not be rounded down."""
    return math.ceil(round(value * 10**digits, 6)) / 10**digits


def draw_text_panel(
    image: np.ndarray, lines: Sequence[str], corner: Corner = "top left", scale: float = 0.45, first_row: int = 0,
    obstacles: Sequence[np.ndarray] = (),
) -> np.ndarray:  # fmt: skip
    """Return a copy of an image (H, W, 3) uint8 with lines of ASCII text on a dark, translucent panel in a corner.

    A panel at the top starts at `first_row`. If there is too little space, the last lines are left out.

    Parameters
    ----------
    obstacles
        Masks (H, W) uint8 of objects that should stay visible, in order. The panel is placed as close to its corner as
        the first mask allows, with narrower or fewer lines if necessary. If not even one line fits, the next mask is
        tried, and finally the corner itself is used.

    Raises
    ------
    ValueError
        The corner is unknown.
    """
    if corner not in Corner.__args__:
        raise ValueError(f"there is no corner {corner!r}: choose one of {', '.join(Corner.__args__)}.")
    out = image.copy()
    if not lines:
        return out
    height, width = out.shape[:2]
    rooms = [share * width for share in PANEL_WIDTHS]
    shapes = [
        (letters, [wrap_line(line, room, letters) for line in lines])
        for letters, room in itertools.product((scale, RETRY_SCALE * scale), rooms)
    ]
    wish = 0 if "left" in corner else width, BORDER_DISTANCE + first_row if "top" in corner else height
    for sight, kept, (letters, parts) in itertools.product(obstacles, range(len(lines), 0, -1), shapes):
        broken = [part for line in parts[:kept] for part in line]
        size, step = _compute_size(broken, letters)
        place = find_free_position(sight, size, wish)
        if place is not None:
            return _write_panel(out, broken, place, size, step, letters)
    broken = [part for line in lines for part in wrap_line(line, width - 4 * BORDER_DISTANCE, scale)]
    broken = broken[: max((height - first_row - 3 * BORDER_DISTANCE) // _compute_size(broken, scale)[1], 1)]
    size, step = _compute_size(broken, scale)
    top = BORDER_DISTANCE + first_row if "top" in corner else max(height - size[1] - BORDER_DISTANCE, 0)
    left = BORDER_DISTANCE if "left" in corner else max(width - size[0] - BORDER_DISTANCE, 0)
    return _write_panel(out, broken, (left, top), size, step, scale)


def _compute_size(lines: Sequence[str], scale: float) -> tuple[tuple[int, int], int]:
    """Compute width and height of a text panel, and its line spacing [pixel]."""
    sizes = [cv2.getTextSize(line, FONT, scale, 1)[0] for line in lines]
    step = max(height for _, height in sizes) + BORDER_DISTANCE
    return (max(width for width, _ in sizes) + 2 * BORDER_DISTANCE, step * len(lines) + BORDER_DISTANCE), step


def _write_panel(
    image: np.ndarray, lines: Sequence[str], position: tuple[int, int], size: tuple[int, int], step: int, scale: float
) -> np.ndarray:
    """Draw a text panel into an image (H, W, 3) uint8 with its upper left corner at `position`; return the image."""
    left, top = position
    ground = image[top : top + size[1], left : left + size[0]]
    ground[:] = ground * 0.35 + np.array([6.0, 9.0, 11.0])
    for number, line in enumerate(lines, start=1):
        write_text(image, line, (left + BORDER_DISTANCE, top + number * step), scale)
    return image


def name_direction(direction: np.ndarray) -> str:
    """Name a direction (3,) in RAS by one or two orientation letters, such as "R" or "AS", larger component first.

    The letters are those of the patient: L left, R right, A anterior, P posterior, S superior, I inferior.
    """
    part = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    axes = [axis for axis in np.argsort(-np.abs(part), kind="stable")[:2] if abs(part[axis]) > MIN_OBLIQUE]
    return "".join(SIDES[axis][int(part[axis] < 0.0)] for axis in axes)


def name_edge_directions(rotation: np.ndarray) -> dict[str, str]:
    """Return the orientation letters of an image's edges; `rotation` (3, 3) maps RAS to x right, y down, z forward."""
    right, down = np.asarray(rotation)[:2]
    return {
        "left": name_direction(-right),
        "right": name_direction(right),
        "top": name_direction(-down),
        "bottom": name_direction(down),
    }


def draw_orientation_labels(image: np.ndarray, rotation: np.ndarray, occupied: np.ndarray) -> np.ndarray:
    """Return a copy of an image (H, W, 3) uint8 with orientation letters at its edges.

    `rotation` (3, 3) is as in `name_edge_directions`; `occupied` (H, W) uint8 is above 0 at lines and text.
    """
    out, occupied = image.copy(), occupied.copy()
    height, width = occupied.shape
    for edge, letters in name_edge_directions(rotation).items():
        (long, tall), below = cv2.getTextSize(letters, FONT, LETTER_SCALE, 1)
        # Not at the centre of the top and bottom edges: tools enter there, and a tumour may extend to the bottom.
        strip, wish = {
            "left": (np.s_[:, : long + 2 * BORDER_DISTANCE], (0, (height - tall) // 2)),
            "right": (np.s_[:, -long - 2 * BORDER_DISTANCE :], (width, (height - tall) // 2)),
            "top": (np.s_[: tall + below + 2 * BORDER_DISTANCE], (width // 4 - long // 2, 0)),
            "bottom": (np.s_[-tall - below - 2 * BORDER_DISTANCE :], (3 * width // 4 - long // 2, height)),
        }[edge]
        elsewhere = np.ones_like(occupied)
        elsewhere[strip] = occupied[strip]
        place_text(out, elsewhere, [letters], wish, LETTER_SCALE)
        occupied[strip] = elsewhere[strip]
    return out

"""Legend of the overlay's lines in a corner of the image, and the scale of its tint."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from .hud import FONT, HEAD_ROW, WHITE, write_haloed
from .outlines import OPAQUE
from .text_placement import BORDER_DISTANCE, TEXT_DISTANCE
from .window import BORDER_COLOUR, DEPTH_STEP, DEPTH_STEP_COUNT, MAX_TINT_OPACITY, MIN_TINT_OPACITY

LEGEND_TEXT_SCALE = 0.4  # Font scale of a legend.
SAMPLE_LENGTH = 26  # Length of a line's sample [pixel].
SAMPLE_GAP = 6  # Gap after a line's sample [pixel].
LEGEND_LINE_HEIGHT = 16  # Height of a line of text [pixel].
TINT_STEP_HEIGHT = 12  # Height of a step of the tint's scale [pixel].
MIN_IMAGE_WIDTH = 480  # Smallest image width with a legend [pixel].
GROUND_COLOUR = (200.0, 150.0, 135.0)  # Ground colour under the tint's scale (RGB).
SHEET_VALUE = 255
"""Value of `taken` at a legend, a scale or an inset: no panel goes there."""


@dataclass(frozen=True)
class LegendNames:
    """Names of the overlay's lines in a legend; lines without a name are left out.

    Parameters
    ----------
    now, margin, before
        The hidden surface, the dashed line round it, and its earlier position.
    traces
        Other surfaces, in the given order.
    motion
        Name of the length at the bottom: motion of the hidden surface.
    """

    now: str = ""
    margin: str = ""
    before: str = ""
    traces: tuple[str, ...] = ()
    motion: str = "moved"


@dataclass(frozen=True)
class Entry:
    """Line of a legend: name, colour (3,) in 0 .. 255, strokes and gaps [pixel] (None: solid) and width [pixel]."""

    name: str
    ink: tuple[float, ...]
    pattern: tuple[int, int] | None = None
    width: int = 2


@lru_cache(maxsize=16)
def draw_legend(entries: tuple[Entry, ...]) -> np.ndarray:
    """Draw a sheet (h, w, 4) uint8, colour times coverage and coverage: a sample of each line, and its name."""
    wide = max(cv2.getTextSize(entry.name, FONT, LEGEND_TEXT_SCALE, 1)[0][0] for entry in entries)
    sheet = np.zeros((LEGEND_LINE_HEIGHT * len(entries), SAMPLE_LENGTH + SAMPLE_GAP + wide + 4, 4), np.uint8)
    for number, entry in enumerate(entries):
        row = LEGEND_LINE_HEIGHT * number + LEGEND_LINE_HEIGHT // 2
        stroke, gap = entry.pattern or (SAMPLE_LENGTH, 0)
        strokes = [(left, min(left + stroke, SAMPLE_LENGTH) - 1) for left in range(2, SAMPLE_LENGTH - 2, stroke + gap)]
        rim = [(BORDER_COLOUR, entry.width + 2)] if entry.width > 1 else []  # border as in `draw_dashes`
        for ink, width in (*rim, (entry.ink, entry.width)):
            for left, right in strokes:
                cv2.line(sheet, (left, row), (right, row), (*ink, OPAQUE), width, cv2.LINE_AA)
        write_haloed(sheet, entry.name, (SAMPLE_LENGTH + SAMPLE_GAP, row + 4), LEGEND_TEXT_SCALE)
    return sheet


@lru_cache(maxsize=4)
def draw_depth_scale(ink: tuple[float, ...], caption: str) -> np.ndarray:
    """Draw a sheet (h, w, 4) uint8: the tint of the depth style by depth, with millimetres and a caption."""
    lines = caption.split("\n")
    wide = max(cv2.getTextSize(line, FONT, LEGEND_TEXT_SCALE, 1)[0][0] for line in lines)
    sheet = np.zeros(
        (LEGEND_LINE_HEIGHT * len(lines) + DEPTH_STEP_COUNT * TINT_STEP_HEIGHT + 10, wide + 4, 4), np.uint8
    )
    for number, line in enumerate(lines):
        write_haloed(sheet, line, (0, LEGEND_LINE_HEIGHT * number + 12), LEGEND_TEXT_SCALE)
    top = LEGEND_LINE_HEIGHT * len(lines) + 4
    for step in range(DEPTH_STEP_COUNT):
        tint = MAX_TINT_OPACITY - (MAX_TINT_OPACITY - MIN_TINT_OPACITY) * step / (DEPTH_STEP_COUNT - 1)
        row = top + step * TINT_STEP_HEIGHT
        sheet[row : row + TINT_STEP_HEIGHT, 2:16, :3] = (1.0 - tint) * np.array(GROUND_COLOUR) + tint * np.array(ink)
        sheet[row : row + TINT_STEP_HEIGHT, 2:16, 3] = OPAQUE
        if step % 2 == 0:
            cv2.line(sheet, (16, row), (20, row), (*WHITE, OPAQUE), 1)
            write_haloed(sheet, f"{1e3 * DEPTH_STEP * step:.0f}", (24, row + 4), LEGEND_TEXT_SCALE)
    return sheet


def place_sheet(colour: np.ndarray, taken: np.ndarray, sheet: np.ndarray, sights: np.ndarray) -> bool:
    """Place a sheet at the right of an image, or else at its left, in free space; return True if there was space.

    Parameters
    ----------
    colour, taken
        The image (H, W, 3) uint8; (H, W) uint8, above 0 at lines and text. Both change in place.
    sheet
        (h, w, 4) uint8: colour times coverage, and coverage.
    sights
        (H, W) uint8: above 0 on what should stay visible, as tools.
    """
    (height, width), (tall, wide) = taken.shape, sheet.shape[:2]
    if width < MIN_IMAGE_WIDTH:
        return False
    upper, lower = (
        height // 2 - HEAD_ROW // 2,
        height // 2 + HEAD_ROW // 2,
    )  # orientation letters are between, and at both ends
    rows = [row for row in (HEAD_ROW, upper - tall) if HEAD_ROW <= row <= upper - tall]
    rows += [row for row in (lower, height - HEAD_ROW - tall) if lower <= row <= height - HEAD_ROW - tall]
    for column in (width - BORDER_DISTANCE - wide, BORDER_DISTANCE):
        for row in rows:
            around = np.s_[
                row - TEXT_DISTANCE : row + tall + TEXT_DISTANCE, column - TEXT_DISTANCE : column + wide + TEXT_DISTANCE
            ]
            if not taken[around].any() and not sights[around].any():
                paste(colour, taken, sheet, (column, row))
                return True
    return False


def paste(colour: np.ndarray, taken: np.ndarray, sheet: np.ndarray, at: tuple[int, int]) -> None:
    """Paste a sheet (h, w, 4) uint8 over an image (H, W, 3) uint8 at a column and a row.

    Its place becomes `SHEET_VALUE`.
    """
    column, row = at
    box = np.s_[row : row + sheet.shape[0], column : column + sheet.shape[1]]
    left = 1.0 - sheet[..., 3:] / np.float32(OPAQUE)
    colour[box] = np.minimum(colour[box] * left + sheet[..., :3], 255.0)
    taken[box] = SHEET_VALUE

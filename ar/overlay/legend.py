"""Legend of the overlay's lines, and scale of the depth tint, as insets in an image."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from .hud import FONT, HEAD_ROW, WHITE, write_text_with_halo
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
"""Value of an inset's pixels in the mask of occupied pixels; no text panel is placed there."""


@dataclass(frozen=True)
class LegendNames:
    """Names of the overlay's lines in its legend; lines without a name are not listed.

    Parameters
    ----------
    current, margin, initial
        Names of the hidden surface, of the dashed error margin round it, and of its earlier position.
    outlines
        Names of other surfaces, in the order of their outlines.
    motion
        Name of the length at the bottom of the image, which is the motion of the hidden surface.
    """

    current: str = ""
    margin: str = ""
    initial: str = ""
    outlines: tuple[str, ...] = ()
    motion: str = "moved"


@dataclass(frozen=True)
class LegendEntry:
    """Entry of a legend: name, colour (3,) in 0 .. 255, stroke and gap [pixel] (None: solid) and line width [pixel]."""

    name: str
    colour: tuple[float, ...]
    pattern: tuple[int, int] | None = None
    width: int = 2


@lru_cache(maxsize=16)
def draw_legend(entries: tuple[LegendEntry, ...]) -> np.ndarray:
    """Draw a legend (h, w, 4) uint8 (premultiplied colour, coverage): a sample of each line, and its name."""
    wide = max(cv2.getTextSize(entry.name, FONT, LEGEND_TEXT_SCALE, 1)[0][0] for entry in entries)
    sheet = np.zeros((LEGEND_LINE_HEIGHT * len(entries), SAMPLE_LENGTH + SAMPLE_GAP + wide + 4, 4), np.uint8)
    for number, entry in enumerate(entries):
        row = LEGEND_LINE_HEIGHT * number + LEGEND_LINE_HEIGHT // 2
        stroke, gap = entry.pattern or (SAMPLE_LENGTH, 0)
        strokes = [(left, min(left + stroke, SAMPLE_LENGTH) - 1) for left in range(2, SAMPLE_LENGTH - 2, stroke + gap)]
        rim = [(BORDER_COLOUR, entry.width + 2)] if entry.width > 1 else []  # border as in `draw_dashes`
        for ink, width in (*rim, (entry.colour, entry.width)):
            for left, right in strokes:
                cv2.line(sheet, (left, row), (right, row), (*ink, OPAQUE), width, cv2.LINE_AA)
        write_text_with_halo(sheet, entry.name, (SAMPLE_LENGTH + SAMPLE_GAP, row + 4), LEGEND_TEXT_SCALE)
    return sheet


@lru_cache(maxsize=4)
def draw_depth_scale(colour: tuple[float, ...], caption: str) -> np.ndarray:
    """Draw the scale (h, w, 4) uint8 of the depth style: tint by depth, with millimetres and a caption."""
    lines = caption.split("\n")
    wide = max(cv2.getTextSize(line, FONT, LEGEND_TEXT_SCALE, 1)[0][0] for line in lines)
    sheet = np.zeros(
        (LEGEND_LINE_HEIGHT * len(lines) + DEPTH_STEP_COUNT * TINT_STEP_HEIGHT + 10, wide + 4, 4), np.uint8
    )
    for number, line in enumerate(lines):
        write_text_with_halo(sheet, line, (0, LEGEND_LINE_HEIGHT * number + 12), LEGEND_TEXT_SCALE)
    top = LEGEND_LINE_HEIGHT * len(lines) + 4
    for step in range(DEPTH_STEP_COUNT):
        tint = MAX_TINT_OPACITY - (MAX_TINT_OPACITY - MIN_TINT_OPACITY) * step / (DEPTH_STEP_COUNT - 1)
        row = top + step * TINT_STEP_HEIGHT
        sheet[row : row + TINT_STEP_HEIGHT, 2:16, :3] = (1.0 - tint) * np.array(GROUND_COLOUR) + tint * np.array(colour)
        sheet[row : row + TINT_STEP_HEIGHT, 2:16, 3] = OPAQUE
        if step % 2 == 0:
            cv2.line(sheet, (16, row), (20, row), (*WHITE, OPAQUE), 1)
            write_text_with_halo(sheet, f"{1e3 * DEPTH_STEP * step:.0f}", (24, row + 4), LEGEND_TEXT_SCALE)
    return sheet


def place_inset(image: np.ndarray, occupied: np.ndarray, inset: np.ndarray, obstacles: np.ndarray) -> bool:
    """Place an inset at the right or else the left of an image, in free space; return True if there was space.

    Parameters
    ----------
    image, occupied
        Image (H, W, 3) uint8, and mask (H, W) uint8 of lines and text; both change in place.
    inset
        Inset (h, w, 4) uint8: premultiplied colour, and coverage.
    obstacles
        Mask (H, W) uint8 of objects that must stay visible, such as tools.
    """
    (height, width), (tall, wide) = occupied.shape, inset.shape[:2]
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
            if not occupied[around].any() and not obstacles[around].any():
                paste_inset(image, occupied, inset, (column, row))
                return True
    return False


def paste_inset(image: np.ndarray, occupied: np.ndarray, inset: np.ndarray, position: tuple[int, int]) -> None:
    """Paste an inset (h, w, 4) uint8 over an image (H, W, 3) uint8 at (column, row), in place.

    Its pixels become `SHEET_VALUE` in `occupied`.
    """
    column, row = position
    box = np.s_[row : row + inset.shape[0], column : column + inset.shape[1]]
    left = 1.0 - inset[..., 3:] / np.float32(OPAQUE)
    image[box] = np.minimum(image[box] * left + inset[..., :3], 255.0)
    occupied[box] = SHEET_VALUE

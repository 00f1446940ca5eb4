"""Legend of the overlay's lines in a corner of the image, and the scale of its tint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from .hud import FONT, HEAD, WHITE, write_haloed
from .outlines import OPAQUE
from .places import CLEAR, PAD
from .window import DARK, FAINTEST, STEP, STEPS, STRONGEST

SMALL = 0.4  # Font scale of a legend.
SAMPLE = 26  # Length of a line's sample [pixel].
AFTER = 6  # Gap after a line's sample [pixel].
LEADING = 16  # Height of a line of text [pixel].
TALL = 12  # Height of a step of the tint's scale [pixel].
LEAST = 480  # Smallest image width with a legend [pixel].
GROUND = (200.0, 150.0, 135.0)  # Ground colour under the tint's scale (RGB).
SHEET = 255
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
    wide = max(cv2.getTextSize(entry.name, FONT, SMALL, 1)[0][0] for entry in entries)
    sheet = np.zeros((LEADING * len(entries), SAMPLE + AFTER + wide + 4, 4), np.uint8)
    for number, entry in enumerate(entries):
        row = LEADING * number + LEADING // 2
        stroke, gap = entry.pattern or (SAMPLE, 0)
        strokes = [(left, min(left + stroke, SAMPLE) - 1) for left in range(2, SAMPLE - 2, stroke + gap)]
        rim = [(DARK, entry.width + 2)] if entry.width > 1 else []  # border as in `dash`
        for ink, width in (*rim, (entry.ink, entry.width)):
            for left, right in strokes:
                cv2.line(sheet, (left, row), (right, row), (*ink, OPAQUE), width, cv2.LINE_AA)
        write_haloed(sheet, entry.name, (SAMPLE + AFTER, row + 4), SMALL)
    return sheet


@lru_cache(maxsize=4)
def draw_depth_scale(ink: tuple[float, ...], caption: str) -> np.ndarray:
    """Draw a sheet (h, w, 4) uint8: the tint of the depth style by depth, with millimetres and a caption."""
    lines = caption.split("\n")
    wide = max(cv2.getTextSize(line, FONT, SMALL, 1)[0][0] for line in lines)
    sheet = np.zeros((LEADING * len(lines) + STEPS * TALL + 10, wide + 4, 4), np.uint8)
    for number, line in enumerate(lines):
        write_haloed(sheet, line, (0, LEADING * number + 12), SMALL)
    top = LEADING * len(lines) + 4
    for step in range(STEPS):
        tint = STRONGEST - (STRONGEST - FAINTEST) * step / (STEPS - 1)
        row = top + step * TALL
        sheet[row : row + TALL, 2:16, :3] = (1.0 - tint) * np.array(GROUND) + tint * np.array(ink)
        sheet[row : row + TALL, 2:16, 3] = OPAQUE
        if step % 2 == 0:
            cv2.line(sheet, (16, row), (20, row), (*WHITE, OPAQUE), 1)
            write_haloed(sheet, f"{1e3 * STEP * step:.0f}", (24, row + 4), SMALL)
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
    if width < LEAST:
        return False
    upper, lower = height // 2 - HEAD // 2, height // 2 + HEAD // 2  # orientation letters are between, and at both ends
    rows = [row for row in (HEAD, upper - tall) if HEAD <= row <= upper - tall]
    rows += [row for row in (lower, height - HEAD - tall) if lower <= row <= height - HEAD - tall]
    for column in (width - PAD - wide, PAD):
        for row in rows:
            around = np.s_[row - CLEAR : row + tall + CLEAR, column - CLEAR : column + wide + CLEAR]
            if not taken[around].any() and not sights[around].any():
                paste(colour, taken, sheet, (column, row))
                return True
    return False


def paste(colour: np.ndarray, taken: np.ndarray, sheet: np.ndarray, at: tuple[int, int]) -> None:
    """Paste a sheet (h, w, 4) uint8 over an image (H, W, 3) uint8 at a column and a row; its place becomes `SHEET`."""
    column, row = at
    box = np.s_[row : row + sheet.shape[0], column : column + sheet.shape[1]]
    left = 1.0 - sheet[..., 3:] / np.float32(OPAQUE)
    colour[box] = np.minimum(colour[box] * left + sheet[..., :3], 255.0)
    taken[box] = SHEET

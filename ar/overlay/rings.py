"""Rings on what is seen: lines along which it is equally far from a hidden surface."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from .hud import FINE, FONT
from .outlines import OPAQUE, inner, outlines, pieces
from .window import DARK

# Distances of the rings [m]; the first is as good as none.
RINGS = (1e-3, 5e-3, 10e-3, 15e-3)
RING = (232.0, 228.0, 204.0)
"""Ink of rings."""
# A ring of fewer pixels is no line. Rings keep so far from where the ground ends [pixel].
SHORTEST, OFF = 24, 3
# The largest gap in a ring for its number, on both sides of the number [pixel].
ROOM = 3
# No line is so thick, and every number is [pixel].
THICK = 9
# A piece of so many pixels has a number of its own.
LONG = 80


def draw_rings(sheet: np.ndarray, distance: np.ndarray, free: np.ndarray, levels: Sequence[float] = RINGS) -> list[str]:
    """Draw rings with their numbers in millimetres, in place; returns the numbers of the rings that are drawn.

    Each piece that is long enough has its number, and each ring one at least, even over other lines.

    Parameters
    ----------
    sheet
        (h, w, 4) uint8.
    distance
        (h, w) float32 [m] from what is seen at each pixel to the hidden surface; NaN where that has no ring.
    free
        (h, w) bool: where a number may stand; it is false where other lines are.
    """
    ground = np.isfinite(distance).astype(np.uint8)
    within = cv2.erode(ground, np.ones((2 * OFF + 1,) * 2, np.uint8), borderValue=0) > 0
    rings: dict[str, list[np.ndarray]] = {}
    for level in levels:
        near = np.nan_to_num(distance, nan=np.inf) < level
        lines = [line for line in pieces(outlines(near), within) if len(line) >= SHORTEST]
        lines = [line for piece in lines for line in inner(piece, sheet.shape[1], sheet.shape[0])]
        if lines:
            rings[f"{1e3 * level:.0f}"] = sorted(lines, key=len, reverse=True)
    for lines in rings.values():
        for ink, width in ((DARK, 3), (RING, 1)):
            cv2.polylines(sheet, lines, False, (*ink, OPAQUE), width, cv2.LINE_AA)
    taken, written = ~free, np.zeros(free.shape, bool)
    for number, lines in rings.items():
        found = [_write_on(sheet, line, number, taken, written) for line in lines if len(line) >= LONG]
        if not any(found):
            # Where nothing is free: first over lines, and then over another number.
            any(
                _write_on(sheet, line, number, shut, written)
                for shut in (written, np.zeros_like(written))
                for line in lines
            )
    return list(rings)


def lines_of(drawn: np.ndarray) -> np.ndarray:
    """Rings (h, w) without their numbers, of what is `drawn` (h, w) of both, bool."""
    numbers = cv2.morphologyEx(drawn.astype(np.uint8), cv2.MORPH_OPEN, np.ones((THICK,) * 2, np.uint8))
    return drawn & (numbers == 0)


def _write_on(sheet: np.ndarray, line: np.ndarray, text: str, shut: np.ndarray, written: np.ndarray) -> bool:
    """Write a number on a line (n, 1, 2), as near to its middle as nothing is `shut`, in place; whether it could.

    Its place is marked in both (h, w) bool.
    """
    (width, height), _ = cv2.getTextSize(text, FONT, FINE, 1)
    middle = len(line) // 2
    for at in sorted(range(0, len(line), 4), key=lambda at: abs(at - middle)):
        column, row = line[at, 0].tolist()
        left, top = column - width // 2, row - height // 2
        box = slice(max(top - ROOM, 0), top + height + ROOM), slice(max(left - ROOM, 0), left + width + ROOM)
        if left >= ROOM and top >= ROOM and not shut[box].any() and _fits(sheet, box):
            cv2.rectangle(sheet, (left - 2, top - 2), (left + width + 1, top + height + 1), (*DARK, OPAQUE), -1)
            cv2.putText(sheet, text, (left, top + height), FONT, FINE, (*RING, OPAQUE), 1, cv2.LINE_AA)
            shut[box] = written[box] = True
            return True
    return False


def _fits(sheet: np.ndarray, box: tuple[slice, slice]) -> bool:
    return box[0].stop <= sheet.shape[0] and box[1].stop <= sheet.shape[1]

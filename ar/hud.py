"""Words on the picture: a number beside a thing, a panel in a corner."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np

Corner = Literal["top left", "top right", "bottom left", "bottom right"]
FONT = cv2.FONT_HERSHEY_SIMPLEX
WHITE = (244, 244, 240)
PAD = 8
# Scale of the lines at the foot of a picture, and from one's baseline to the next [pixel].
FINE, ROW = 0.45, 18
# The patient's sides along the axes of RAS, and against them.
SIDES = ("RL", "AP", "SI")
# A direction's second letter is told where it is more than so much of it.
OBLIQUE = 0.38


def write(colour: np.ndarray, text: str, at: tuple[int, int], scale: float = 0.5, ink: Sequence[float] = WHITE) -> None:
    """Write one line of ASCII text into the picture (H, W, 3) uint8, its baseline's left end at (column, row).

    A dark halo keeps it legible on any ground; the line is moved as far as it takes to lie inside the picture.
    """
    (width, above), below = cv2.getTextSize(text, FONT, scale, 1)
    column = min(max(at[0], 2), max(colour.shape[1] - width - 3, 2))
    row = min(max(at[1], above + 2), max(colour.shape[0] - below - 2, above + 2))
    box = slice(max(row - above - 4, 0), row + below + 5), slice(max(column - 4, 0), column + width + 5)
    halo = np.zeros(colour[box].shape[:2], np.uint8)
    cv2.putText(halo, text, (column - box[1].start, row - box[0].start), FONT, scale, (200,), 1, cv2.LINE_AA)
    halo = cv2.dilate(halo, np.ones((3, 3), np.uint8))[..., None] / 255.0
    colour[box] = colour[box] * (1.0 - halo) + 12.0 * halo
    cv2.putText(colour, text, (column, row), FONT, scale, tuple(ink), 1, cv2.LINE_AA)


def foot(colour: np.ndarray, text: str, row: int, right: bool = False, ink: Sequence[float] = WHITE) -> None:
    """Write a line into the picture's lower left corner, or lower right, so many rows over its foot, in place."""
    width = cv2.getTextSize(text, FONT, FINE, 1)[0][0]
    write(colour, text, (colour.shape[1] - PAD - width if right else PAD, colour.shape[0] - PAD - row * ROW), FINE, ink)


def millimetres(length: float, error: float | None = None) -> str:
    """A length [m] as it is read: in millimetres, with what it may be off by [m], rounded up, where that is finite."""
    beside = ""
    if error is not None and math.isfinite(error):
        beside = f" +- {max(rounded_up(1e3 * error, 1), 0.1):.1f}"
    return f"{1e3 * length:.1f}{beside} mm"


def rounded_up(value: float, digits: int) -> float:
    """The least number of so many decimals that is no smaller, for bounds: they may not be told too small."""
    return math.ceil(round(value * 10**digits, 6)) / 10**digits


def panel(colour: np.ndarray, lines: Sequence[str], corner: Corner = "top left", scale: float = 0.45) -> np.ndarray:
    """The picture (H, W, 3) uint8 with lines of ASCII text on a dark translucent ground in one corner; a copy.

    Raises ValueError for an unknown corner.
    """
    if corner not in Corner.__args__:
        raise ValueError(f"there is no corner {corner!r}: choose one of {', '.join(Corner.__args__)}.")
    out = colour.copy()
    if not lines:
        return out
    sizes = [cv2.getTextSize(line, FONT, scale, 1)[0] for line in lines]
    step = max(height for _, height in sizes) + PAD
    height, width = step * len(lines) + PAD, max(width for width, _ in sizes) + 2 * PAD
    top = PAD if "top" in corner else max(out.shape[0] - height - PAD, 0)
    left = PAD if "left" in corner else max(out.shape[1] - width - PAD, 0)
    ground = out[top : top + height, left : left + width]
    ground[:] = ground * 0.35 + np.array([6.0, 9.0, 11.0])
    for number, line in enumerate(lines, start=1):
        write(out, line, (left + PAD, top + number * step), scale)
    return out


def towards(direction: np.ndarray) -> str:
    """Where a direction (3,) of RAS points, in a surgeon's letters: "R", or "AS" between two, the greater part first.

    L left, R right, A anterior, P posterior, S superior, I inferior; of the patient.
    """
    part = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    axes = [axis for axis in np.argsort(-np.abs(part), kind="stable")[:2] if abs(part[axis]) > OBLIQUE]
    return "".join(SIDES[axis][int(part[axis] < 0.0)] for axis in axes)


def bearings(rotation: np.ndarray) -> dict[str, str]:
    """What lies left, right, up and down of a picture: `rotation` (3, 3) turns RAS to x right, y down, z forward."""
    right, down = np.asarray(rotation)[:2]
    return {"left": towards(-right), "right": towards(right), "top": towards(-down), "bottom": towards(down)}


def marked(colour: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The picture (H, W, 3) uint8 with the patient's sides at its edges; a copy.

    rotation (3, 3): of the camera, as `bearings` takes it.
    """
    out = colour.copy()
    height, width = out.shape[:2]
    # Not at the middles of top and foot: tools come in there, and a tumour may reach down to the foot.
    at = {
        "left": (8, height // 2),
        "right": (width, height // 2),
        "top": (width // 4, 0),
        "bottom": (3 * width // 4, height),
    }
    for edge, letters in bearings(rotation).items():
        (long, tall), _ = cv2.getTextSize(letters, FONT, 0.6, 1)
        column, row = at[edge]
        inset = {"left": 0, "right": -long - 8, "top": -long // 2, "bottom": -long // 2}[edge]
        rise = {"left": tall // 2, "right": tall // 2, "top": tall + 8, "bottom": -10}[edge]
        write(out, letters, (column + inset, row + rise), 0.6)
    return out

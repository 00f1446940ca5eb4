"""Charts with logarithmic axes, drawn large and made small so that lines and letters are smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

# Pixels are drawn so many times finer than they are shown.
FINER = 3
WIDTH, HEIGHT = 640, 480
LEFT, RIGHT, TOP, BOTTOM = 78, 20, 62, 62
INK, FAINT, GRID, PAPER = (40, 40, 40), (120, 120, 120), (228, 228, 228), (255, 255, 255)
COLOURS = ((31, 119, 180), (214, 96, 37), (44, 140, 72), (140, 86, 170), (150, 120, 40))
"""Red, green, blue of the curves, in turn."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class Curve:
    """Points (x, y), both positive, under a name."""

    name: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Panel:
    """One pair of axes: title, what they show, curves, and `marks`: vertical lines at some x, with words beside."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    marks: tuple[tuple[float, str], ...] = ()


def drawn(panels: Sequence[Panel]) -> np.ndarray:
    """Panels side by side, (480, 640 n, 3) uint8.

    Raises
    ------
    ValueError
        No panel, or one without a point that is positive.
    """
    if not panels:
        raise ValueError("a chart without panels shows nothing: give at least one.")
    return np.hstack([_drawn(panel) for panel in panels])


def _drawn(panel: Panel) -> np.ndarray:
    points = np.array([point for curve in panel.curves for point in curve.points], float).reshape(-1, 2)
    if not len(points) or not (points > 0.0).all():
        raise ValueError(f"{panel.title}: logarithmic axes show positive numbers, and at least one point.")
    canvas = np.full((FINER * HEIGHT, FINER * WIDTH, 3), PAPER, np.uint8)
    low, high = _range(points[:, 0]), _range(points[:, 1])

    def place(x: float, y: float) -> tuple[int, int]:
        across, up = (np.log10(v / a) / np.log10(b / a) for v, (a, b) in ((x, low), (y, high)))
        column, row = LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)
        return int(FINER * column), int(FINER * row)

    for x in _ticks(*low):
        _line(canvas, place(x, high[0]), place(x, high[1]), GRID, 1)
        _write(canvas, _short(x), place(x, high[0]), (-0.5, 1.7), 0.42, FAINT)
    for y in _ticks(*high):
        _line(canvas, place(low[0], y), place(low[1], y), GRID, 1)
        _write(canvas, _short(y), place(low[0], y), (-1.15, 0.5), 0.42, FAINT)
    for x, name in panel.marks:
        top, bottom = place(x, high[1]), place(x, high[0])
        for row in range(top[1], bottom[1], 10 * FINER):
            _line(canvas, (top[0], row), (top[0], row + 5 * FINER), FAINT, 1)
        _write(canvas, name, (top[0] + 5 * FINER, bottom[1] - 8 * FINER), (0.0, 0.0), 0.42, FAINT)
    cv2.rectangle(canvas, place(low[0], high[1]), place(low[1], high[0]), FAINT, FINER)
    for number, curve in enumerate(panel.curves):
        colour = COLOURS[number % len(COLOURS)]
        where = [place(*point) for point in sorted(curve.points)]
        for first, second in pairwise(where):
            _line(canvas, first, second, colour, 2)
        for point in where:
            cv2.circle(canvas, point, 4 * FINER, colour, -1, cv2.LINE_AA)
        key = (FINER * (LEFT + 16), FINER * (TOP + 18 + 20 * number))
        _line(canvas, key, (key[0] + 22 * FINER, key[1]), colour, 3)
        _write(canvas, curve.name, (key[0] + 30 * FINER, key[1]), (0.0, 0.4), 0.45, INK)
    _write(canvas, panel.title, (FINER * LEFT, FINER * 28), (0.0, 0.5), 0.6, INK)
    _write(canvas, panel.y, (FINER * LEFT, FINER * 50), (0.0, 0.5), 0.42, FAINT)
    _write(canvas, panel.x, (FINER * (WIDTH - RIGHT), FINER * (HEIGHT - 18)), (-1.0, 0.5), 0.45, INK)
    return cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def _range(values: np.ndarray) -> tuple[float, float]:
    """Where an axis begins and ends: a little beyond the values, and at least a factor of ten apart."""
    low, high = float(values.min()) / 1.4, float(values.max()) * 1.4
    spare = max(10.0 * low / high, 1.0) ** 0.5
    return low / spare, high * spare


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 of each power of ten, or the powers alone where these would crowd."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    steps = (1.0, 2.0, 5.0) if len(powers) <= 4 else (1.0,)
    return [step * 10.0**power for power in powers for step in steps if low <= step * 10.0**power <= high]


def _short(value: float) -> str:
    """1500 as 1.5k."""
    return f"{value / 1000.0:g}k" if value >= 1000.0 else f"{value:g}"


def _line(
    canvas: np.ndarray, first: tuple[int, int], second: tuple[int, int], colour: Sequence[int], wide: int
) -> None:
    cv2.line(canvas, first, second, tuple(colour), wide * FINER, cv2.LINE_AA)


def _write(
    canvas: np.ndarray, text: str, at: tuple[int, int], shift: tuple[float, float], size: float, ink: Sequence[int]
) -> None:
    """Text at a point, shifted by shares of its width and height."""
    (width, height), _ = cv2.getTextSize(text, FONT, FINER * size, FINER)
    where = int(at[0] + shift[0] * width), int(at[1] + shift[1] * height)
    cv2.putText(canvas, text, where, FONT, FINER * size, tuple(ink), FINER, cv2.LINE_AA)

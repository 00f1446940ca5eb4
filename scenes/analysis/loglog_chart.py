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
COLOURS = (
    (31, 119, 180),
    (214, 96, 37),
    (44, 140, 72),
    (140, 86, 170),
    (150, 120, 40),
    (0, 150, 160),
    (200, 60, 110),
    (110, 110, 110),
    (90, 170, 220),
)
"""Red, green, blue of the curves, in turn."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
# How wide the names of curves are taken to be [pixel].
KEYS = 160
# Radius of a dot, size of its name, and the sides of the dot where that may stand (across, down), the best first.
DOT, SMALL = 5 * FINER, 0.4
SIDES = ((1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (1, 1), (-1, -1), (-1, 1))


@dataclass(frozen=True)
class Curve:
    """Points (x, y), both positive, under a name."""

    name: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Dot:
    """A point (x, y), both positive, with its name beside it, in the colour of its group; or pale."""

    name: str
    group: str
    x: float
    y: float
    pale: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes: title, what they show, curves, dots, and `marks`: lines at some x, with words beside.

    size: width and height [pixel]; y_range: what the axis spans, by default what is shown and a little more.
    """

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...] = ()
    marks: tuple[tuple[float, str], ...] = ()
    dots: tuple[Dot, ...] = ()
    size: tuple[int, int] = (WIDTH, HEIGHT)
    y_range: tuple[float, float] | None = None


def drawn(panels: Sequence[Panel]) -> np.ndarray:
    """Panels of one height side by side, (height, sum of widths, 3) uint8.

    Raises
    ------
    ValueError
        No panel, or one without a point that is positive.
    """
    if not panels:
        raise ValueError("a chart without panels shows nothing: give at least one.")
    return np.hstack([_drawn(panel) for panel in panels])


def _drawn(panel: Panel) -> np.ndarray:
    pairs = [point for curve in panel.curves for point in curve.points] + [(dot.x, dot.y) for dot in panel.dots]
    points = np.array(pairs, float).reshape(-1, 2)
    if not len(points) or not (points > 0.0).all():
        raise ValueError(f"{panel.title}: logarithmic axes show positive numbers, and at least one point.")
    width, height = panel.size
    canvas = np.full((FINER * height, FINER * width, 3), PAPER, np.uint8)
    low, high = _range(points[:, 0]), panel.y_range or _range(points[:, 1])

    def place(x: float, y: float) -> tuple[int, int]:
        across, up = (np.log10(v / a) / np.log10(b / a) for v, (a, b) in ((x, low), (y, high)))
        column, row = LEFT + across * (width - LEFT - RIGHT), height - BOTTOM - up * (height - TOP - BOTTOM)
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
    left = _column_of_keys(panel, [place(*point) for point in pairs])
    for number, curve in enumerate(panel.curves):
        colour = COLOURS[number % len(COLOURS)]
        where = [place(*point) for point in sorted(curve.points)]
        for first, second in pairwise(where):
            _line(canvas, first, second, colour, 2)
        for point in where:
            cv2.circle(canvas, point, 4 * FINER, colour, -1, cv2.LINE_AA)
        key = (FINER * left, FINER * (TOP + 18 + 20 * number))
        _line(canvas, key, (key[0] + 22 * FINER, key[1]), colour, 3)
        _write(canvas, curve.name, (key[0] + 30 * FINER, key[1]), (0.0, 0.4), 0.45, INK)
    _scatter(canvas, panel.dots, [place(dot.x, dot.y) for dot in panel.dots], place(low[0], high[0]))
    _write(canvas, panel.title, (FINER * LEFT, FINER * 28), (0.0, 0.5), 0.6, INK)
    _write(canvas, panel.y, (FINER * LEFT, FINER * 50), (0.0, 0.5), 0.42, FAINT)
    _write(canvas, panel.x, (FINER * (width - RIGHT), FINER * (height - 18)), (-1.0, 0.5), 0.45, INK)
    return cv2.resize(canvas, panel.size, interpolation=cv2.INTER_AREA)


def _column_of_keys(panel: Panel, places: Sequence[tuple[int, int]]) -> int:
    """Where the keys of the curves begin [pixel]: at the left, unless fewer points lie under them at the right."""
    columns = LEFT + 16, panel.size[0] - RIGHT - KEYS
    low = FINER * (TOP + 18 + 20 * len(panel.curves))
    return min(columns, key=lambda x: sum(FINER * x <= at[0] <= FINER * (x + KEYS) and at[1] <= low for at in places))


def _scatter(
    canvas: np.ndarray, dots: Sequence[Dot], places: Sequence[tuple[int, int]], corner: tuple[int, int]
) -> None:
    """Dots and their names, each where it covers least; the groups above the lower left corner of the axes.

    A pale dot without space for its name has none.
    """
    groups = {group: COLOURS[number % len(COLOURS)] for number, group in enumerate({dot.group: 0 for dot in dots})}
    taken = [_around(place, (-DOT, -DOT), (2 * DOT, 2 * DOT)) for place in places]
    height, width = canvas.shape[:2]
    beyond = (-width, 0, LEFT * FINER, height), (width - RIGHT * FINER, 0, 2 * width, height)
    taken += [*beyond, (0, 0, width, TOP * FINER), (0, height - BOTTOM * FINER, width, height)]
    for number, (group, colour) in enumerate(reversed(groups.items())):
        key = corner[0] + 16 * FINER, corner[1] - (16 + 20 * number) * FINER
        cv2.circle(canvas, key, DOT, colour, -1, cv2.LINE_AA)
        _write(canvas, group, (key[0] + 14 * FINER, key[1]), (0.0, 0.4), 0.45, INK)
        taken.append(_around(key, (0, -DOT), (170 * FINER, 2 * DOT)))
    # The pale ones first, so that they cover nothing; they are named last, where room is left.
    order = sorted(range(len(dots)), key=lambda number: not dots[number].pale)
    for number in order:
        ink = 0.35 * np.array(groups[dots[number].group]) + 0.65 * np.array(PAPER)
        colour = ink.astype(int).tolist() if dots[number].pale else groups[dots[number].group]
        cv2.circle(canvas, places[number], DOT, colour, -1, cv2.LINE_AA)
    for number in reversed(order):
        size, _ = cv2.getTextSize(dots[number].name, FONT, FINER * SMALL, FINER)
        boxes = [_beside(places[number], side, size) for side in SIDES]
        covered = [sum(_common(box, other) for other in taken) for box in boxes]
        box = boxes[int(np.argmin(covered))]
        if min(covered) and dots[number].pale:
            continue
        taken.append(box)
        ink = FAINT if dots[number].pale else INK
        cv2.putText(canvas, dots[number].name, (box[0], box[3]), FONT, FINER * SMALL, ink, FINER, cv2.LINE_AA)


def _beside(place: tuple[int, int], side: tuple[int, int], size: Sequence[int]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a text of a size, on one side of a dot."""
    shift = [int(way * (DOT + FINER) + (way - 1) * length / 2) for way, length in zip(side, size, strict=True)]
    return _around(place, shift, size)


def _around(place: tuple[int, int], shift: Sequence[int], size: Sequence[int]) -> tuple[int, int, int, int]:
    left, top = place[0] + shift[0], place[1] + shift[1]
    return left, top, left + size[0], top + size[1]


def _common(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> int:
    """The area that two boxes share [pixel]."""
    across, down = (min(one[k + 2], other[k + 2]) - max(one[k], other[k]) for k in (0, 1))
    return max(across, 0) * max(down, 0)


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

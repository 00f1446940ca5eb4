"""The report's plots: error against time, with the rows that no other beats; error against solves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from surrogate.evaluation.choose import unbeaten

from ..analysis.loglog_chart import Curve, Dot, Panel, drawn
from .row import ERROR, TOLERANCE_ALONE, Figures, Row

SIZE = (880, 560)
DIFFERENT = "another law: model difference"
TIME = "milliseconds a load, one at a time"
Place = tuple[float, float]


def front(rows: Sequence[Row]) -> frozenset[str]:
    """Names of the rows that no other equals or beats in both milliseconds and mean distance from the reference.

    Only errors count: another law is none, and the reference's own elements have none of their mesh.
    """
    return unbeaten(_places((row, row.reference) for row in rows if row.against == ERROR))


def against_time(rows: Sequence[Row]) -> np.ndarray | None:
    """Error against time, (H, W, 3) uint8; the rows off the front pale. None without rows.

    What shows its tolerance alone would stand far below all others, and is left out.
    """
    places = _places((row, row.reference) for row in rows if row.against != TOLERANCE_ALONE)
    group = {row.name: row.family if row.against == ERROR else DIFFERENT for row in rows}
    title = "Error against time: full colour where no other row is both faster and nearer"
    return _scatter(title, "mean distance from the reference at the tumour [mm]", places, group, front(rows))


def learners_against_time(rows: Sequence[Row]) -> np.ndarray | None:
    """What learning lost against time, (H, W, 3) uint8. None without learners."""
    places = _places((row, row.own_fem.get("discs")) for row in rows)
    title = "What learning lost, against time: distance from its own finite elements, left-out discs"
    group = {row.name: row.family for row in rows}
    return _scatter(
        title, "mean distance from its own finite elements at the tumour [mm]", places, group, unbeaten(places)
    )


def against_solves(rows: Sequence[Row]) -> np.ndarray | None:
    """Error against the number of training loads, (H, W, 3) uint8; None without learners."""
    curves = tuple(
        Curve(row.name, tuple((float(count), each.mm.mean) for count, each in row.curve)) for row in rows if row.curve
    )
    y = "mean distance from its own finite elements on left-out discs [mm]"
    return drawn([Panel("Error against solves", "training loads", y, curves, size=SIZE)]) if curves else None


def _places(found: Iterable[tuple[Row, Figures | None]]) -> dict[str, Place]:
    """Milliseconds a load and mean distance [mm] by name, where both are there and can stand on logarithmic axes."""
    return {
        row.name: (row.median, figures.mm.mean)
        for row, figures in found
        if row.median is not None and figures is not None and figures.mm.mean > 0.0
    }


def _scatter(
    title: str, y: str, places: Mapping[str, Place], group: Mapping[str, str], best: frozenset[str]
) -> np.ndarray | None:
    dots = tuple(Dot(name, group[name], *place, pale=name not in best) for name, place in places.items())
    return drawn([Panel(title, TIME, y, dots=dots, size=SIZE)]) if dots else None

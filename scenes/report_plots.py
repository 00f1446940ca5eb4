"""The report's plots: error against time, with the rows that no other beats; error against solves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ar.chart import Curve, Dot, Panel, drawn

from .report_row import ERROR, TOLERANCE_ALONE, Row

SIZE = (880, 560)
DIFFERENT = "another law: model difference"


def front(rows: Sequence[Row]) -> frozenset[str]:
    """Names of the rows that no other equals or beats in both milliseconds and mean distance from the reference.

    Only errors count: another law is none, and the reference's own elements have none of their mesh.
    """
    points = {row.name: place_of(row) for row in rows if row.against == ERROR}
    known = {name: place for name, place in points.items() if place is not None}
    return frozenset(
        name
        for name, (time, error) in known.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in known.values())
    )


def place_of(row: Row) -> tuple[float, float] | None:
    """Milliseconds a load and mean distance from the reference [mm]; None where one is lacking or zero."""
    if row.median is None or row.reference is None or row.reference.mm.mean <= 0.0:
        return None
    return row.median, row.reference.mm.mean


def against_time(rows: Sequence[Row]) -> np.ndarray | None:
    """Error against time, (H, W, 3) uint8; the rows off the front pale. None without rows.

    What shows its tolerance alone would stand far below all others, and is left out.
    """
    best = front(rows)
    dots = tuple(
        Dot(row.name, row.family if row.against == ERROR else DIFFERENT, *place, pale=row.name not in best)
        for row in rows
        if (place := place_of(row)) is not None and row.against != TOLERANCE_ALONE
    )
    title = "Error against time: full colour where no other row is both faster and nearer"
    y = "mean distance from the reference at the tumour [mm]"
    return drawn([Panel(title, "milliseconds a load, one at a time", y, dots=dots, size=SIZE)]) if dots else None


def against_solves(rows: Sequence[Row]) -> np.ndarray | None:
    """Error against the number of loads taught, (H, W, 3) uint8; None without learners."""
    curves = tuple(
        Curve(row.name, tuple((float(count), each.mm.mean) for count, each in row.curve)) for row in rows if row.curve
    )
    y = "mean distance from the teacher on left-out discs [mm]"
    return drawn([Panel("Error against solves", "loads taught", y, curves, size=SIZE)]) if curves else None

"""The power series of a study's finite elements: tabulated once, kept for every row that is made of it."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import replace

from surrogate.parts import EXPANDED

from .report_study import Study
from .report_took import note_seconds, noted_seconds


def tabulate_series(study: Study, progress: Callable[[int, int], object]) -> None:
    """Make the table, if the data says of what tissue; `progress` hears the places that are done, and their number."""
    path = study.expansion.kept
    if path is None or "tissue" not in study.dataset.provenance:
        return
    if path.exists() and noted_seconds(path) is not None:
        return
    path.unlink(missing_ok=True)  # of a run that was stopped before it said what the table took
    begun = clock.perf_counter()
    replace(study.expansion, progress=progress).coefficients  # noqa: B018 (asking makes it)
    note_seconds(path, clock.perf_counter() - begun)


def series_seconds(study: Study, learner: str) -> float:
    """What the table took, if this learner is made of it [s]."""
    path = study.expansion.kept
    return (noted_seconds(path) or 0.0) if learner in EXPANDED and path is not None else 0.0

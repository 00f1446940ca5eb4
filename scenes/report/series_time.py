"""The power series of a study's finite elements: tabulated once, kept for every row that is made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from surrogate.training.shared_inputs import EXPANDED

from .study import Study


def tabulate_series(study: Study, progress: Callable[[int, int], object]) -> None:
    """Make the table, if the data says of what tissue; `progress` hears the places that are done, and their number."""
    if "tissue" in study.dataset.provenance:
        replace(study.expansion, progress=progress).tabulated  # noqa: B018 (asking makes it)


def series_seconds(study: Study, learner: str) -> float:
    """What the table took, if this learner is made of it [s]."""
    return study.expansion.tabulated.seconds if learner in EXPANDED else 0.0

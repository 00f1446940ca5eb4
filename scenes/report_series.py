"""The power series of a study's finite elements: tabulated once, kept for every row that is made of it."""

from __future__ import annotations

import json
import time as clock
from collections.abc import Callable
from dataclasses import replace

from sim.files import written_whole
from surrogate.parts import EXPANDED

from .report_study import Study


def tabulate_series(study: Study, progress: Callable[[int, int], object]) -> None:
    """Make the table, if the data says of what tissue; `progress` hears the places that are done, and their number."""
    path = study.expansion.kept
    if path is None or "tissue" not in study.dataset.provenance:
        return
    told = path.with_suffix(".json")
    if path.exists() and told.exists():
        return
    path.unlink(missing_ok=True)  # of a run that was stopped before it said what the table took
    begun = clock.perf_counter()
    replace(study.expansion, progress=progress).coefficients  # noqa: B018 (asking makes it)
    with written_whole(told, ".json") as partial:
        partial.write_text(json.dumps({"seconds": clock.perf_counter() - begun}))


def series_seconds(study: Study, learner: str) -> float:
    """What the table took, if this learner is made of it [s]."""
    path = study.expansion.kept
    if learner not in EXPANDED or path is None or not path.with_suffix(".json").exists():
        return 0.0
    return json.loads(path.with_suffix(".json").read_text())["seconds"]

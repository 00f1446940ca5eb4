"""What steps of a report took, kept beside the files that they made, for runs that go on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sim.runtime.atomic_files import written_whole
from surrogate.training.expansion import EXPANDED

from .study import Study


def note_seconds(made: Path, seconds: float) -> None:
    """Keep the seconds that a file took to make, in a JSON file of its name."""
    with written_whole(_beside(made), ".json") as partial:
        partial.write_text(json.dumps({"seconds": seconds}))


def noted_seconds(made: Path) -> float | None:
    """What was kept; None where nothing was, or nothing whole."""
    try:
        return float(json.loads(_beside(made).read_text())["seconds"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


def _beside(made: Path) -> Path:
    return made.with_suffix(".json")


def tabulate_series(study: Study, progress: Callable[[int, int], object]) -> None:
    """Make the table, if the data says of what tissue; `progress` hears the places that are done, and their number."""
    if "tissue" in study.dataset.provenance:
        replace(study.expansion, progress=progress).tabulated  # noqa: B018 (asking makes it)


def series_seconds(study: Study, learner: str) -> float:
    """What the table took, if this learner is made of it [s]."""
    return study.expansion.tabulated.seconds if learner in EXPANDED else 0.0

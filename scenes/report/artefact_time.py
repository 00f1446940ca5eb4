"""What a step of a report took, kept beside the file that it made, for runs that go on."""

from __future__ import annotations

import json
from pathlib import Path

from sim.runtime.atomic_files import written_whole


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

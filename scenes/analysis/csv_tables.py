"""Tables as CSV files."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sim.runtime.atomic_files import written_whole


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a line for each row, and a column for each name that one has, whole or not at all."""
    names = dict.fromkeys(name for row in rows for name in row)
    with written_whole(path, ".csv") as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(names))
        writer.writeheader()
        writer.writerows(rows)

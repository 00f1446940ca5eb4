"""Record files of figures, which `python -m benchmarks all` writes after every figure and resumes from."""

import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec

from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors

from .figure_readings import Better
from .figures import PROGRAM

FORMAT = "sulcus bench figures 1"
FORMER = "sulcus bench "
"""Start of the commands in older records."""
KIND = "a record of `python -m benchmarks all`"


@dataclass(frozen=True)
class Origin:
    """Origin of a figure: version and digest of the code, machine, digest of the anatomy, date."""

    version: str
    machine: str
    anatomy: str
    date: str


@dataclass(frozen=True)
class Value:
    """Measured number of a figure."""

    name: str
    value: float
    unit: str
    better: Better


@dataclass(frozen=True)
class Entry:
    """Measured figure, or the reason why it has no numbers.

    Parameters
    ----------
    state
        "measured"; "missed": some numbers are missing, or the command missed a target; "failed"; "skipped".
    values
        Numbers; none if the figure failed or was skipped.
    reason
        Reason why the figure was not measured, or its missed target, in a sentence.
    seconds
        Duration of the command [s].
    """

    name: str
    command: str
    state: Literal["measured", "missed", "failed", "skipped"]
    values: tuple[Value, ...]
    reason: str
    seconds: float
    origin: Origin


@dataclass(frozen=True)
class Record:
    """Content of a record file; version, machine and date are the last run's, and each row has its own."""

    format: Literal["sulcus bench figures 1"]
    version: str
    machine: str
    date: str
    rows: tuple[Entry, ...]


def build_record(origin: Origin, entries: Sequence[Entry]) -> Record:
    """Build the record of a run at `origin`."""
    return Record(FORMAT, origin.version, origin.machine, origin.date, tuple(entries))


def read_record(path: Path) -> Record:
    """Read a record file.

    Raises
    ------
    InputError
        A file that is missing, damaged or of another kind.
    """
    with wrap_errors(
        path, KIND, "Choose another file, or measure anew by `python -m benchmarks all --json FILE.json`."
    ):
        record = msgspec.json.decode(path.read_bytes(), type=Record)
    now = f"{shlex.join(PROGRAM)} "
    return replace(record, rows=tuple(replace(row, command=row.command.replace(FORMER, now, 1)) for row in record.rows))


def write_record(path: Path, record: Record) -> None:
    """Write a record file atomically."""
    with write_atomically(path, ".json") as partial:
        partial.write_text(json.dumps(asdict(record), indent=1, allow_nan=False) + "\n")

"""Files of figures: what `python -m benchmarks all` writes after every figure, and reads again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from sim.arguments import LARGEST as LARGEST_NUMBER
from sim.errors import InputError
from sim.runtime.atomic_files import written_whole
from sim.runtime.outside_files import read_as

from .figure_readings import Better
from .figures import NAMED, PROGRAM, command_of

FORMAT = "sulcus bench figures 1"
FORMER = "sulcus bench "
"""Beginning of the commands in older records."""
KIND = "a record of `python -m benchmarks all`"
LARGEST = 16 * 1024**2
"""Bytes of a file that is read: one of all figures has 0.1 million."""
# Printed on terminals and into pages, so without control characters.
Text = Annotated[str, msgspec.Meta(pattern=r"\A[^\x00-\x1f\x7f-\x9f]*\Z", max_length=2000)]
Number = Annotated[float, msgspec.Meta(ge=0.0, le=LARGEST_NUMBER)]


@dataclass(frozen=True)
class Origin:
    """Where a figure comes from: version and digest of the code, machine, digest of the anatomy, date."""

    version: Text
    machine: Text
    anatomy: Text
    date: Text


@dataclass(frozen=True)
class Value:
    """A number that was measured."""

    name: Text
    value: Number
    unit: Text
    better: Better


@dataclass(frozen=True)
class Entry:
    """A figure as it was measured.

    Parameters
    ----------
    state
        "measured"; "missed": numbers, but not all, or its command did not reach what it was asked; "failed"; "skipped".
    values
        The numbers; none if it failed, or was skipped.
    reason
        A sentence that says why it was not measured, or what it missed.
    seconds
        That its command took.
    """

    name: Text
    command: Text
    state: Literal["measured", "missed", "failed", "skipped"]
    values: tuple[Value, ...]
    reason: Text
    seconds: Number
    origin: Origin

    @property
    def quick(self) -> bool:
        """Whether it was measured with small counts, so that its times mean nothing."""
        figure = NAMED.get(self.name)
        return figure is not None and self.command == command_of(figure, quick=True) != command_of(figure)


@dataclass(frozen=True)
class Record:
    """What a file holds; version, machine and date are the last run's, and each row has its own."""

    format: Literal["sulcus bench figures 1"]
    version: Text
    machine: Text
    date: Text
    rows: tuple[Entry, ...]


def record_of(origin: Origin, entries: Sequence[Entry]) -> Record:
    """The record of a run at `origin`."""
    return Record(FORMAT, origin.version, origin.machine, origin.date, tuple(entries))


def read_record(path: Path) -> Record:
    """Read a file.

    Raises
    ------
    InputError
        A file that is not there, is damaged or is of another kind.
    """
    with read_as(path, KIND, "Choose another file, or measure anew by `python -m benchmarks all --json FILE.json`."):
        with path.open("rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise InputError(f"it has more than {LARGEST // 1024**2} MiB, which {KIND} has not: choose another file.")
        record = msgspec.json.decode(content, type=Record)
    now = f"{shlex.join(PROGRAM)} "
    return replace(record, rows=tuple(replace(row, command=row.command.replace(FORMER, now, 1)) for row in record.rows))


def write_record(path: Path, record: Record) -> None:
    """Write a file, whole or not at all."""
    with written_whole(path, ".json") as partial:
        partial.write_text(json.dumps(asdict(record), indent=1, allow_nan=False) + "\n")

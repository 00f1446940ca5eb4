"""Measurement of figures, each by a process whose JSON output contains the numbers."""

import json
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from scenes.analysis.measurement import describe_machine
from sim.errors import InputError
from sim.geometry.tetmesh import compute_digest
from sim.runtime.optional_packages import install_hint
from sim.runtime.versions import get_version

from ..peers.child_process import HOUSE, ProcessResult, run_command
from .figure_readings import read_number
from .figure_record import Entry, Origin, Value
from .figures import Figure, build_arguments, format_command

BENCH = (sys.executable, "-m", "benchmarks")
LONGEST = 400
"""Maximum length of a reason [characters]."""


def get_code_version() -> str:
    """Return the version of sulcus with a digest of its code, which may change within a version."""
    paths = sorted(
        path for room in ("ar", "benchmarks", "scenes", "sim", "surrogate") for path in (HOUSE / room).rglob("*.py")
    )
    code = b"\0".join(path.relative_to(HOUSE).as_posix().encode() + b"\0" + path.read_bytes() for path in paths)
    return f"{get_version('sulcus')} (code {compute_digest(np.frombuffer(code, np.uint8))})"


@dataclass(frozen=True)
class Run:
    """Settings of a run of figures.

    Parameters
    ----------
    version
        Version of the code from `get_code_version`.
    digest
        Digest of the anatomy.
    anatomy
        File of the anatomy; None: each measurement uses the template.
    is_quick
        True for small counts.
    command
        Command line before a figure's own arguments.
    """

    version: str
    digest: str
    anatomy: Path | None = None
    is_quick: bool = False
    command: Sequence[str] = BENCH

    def build_origin(self, device: str) -> Origin:
        """Return the origin of a figure that a device measures today.

        Raises
        ------
        InputError
            A device that this machine does not have.
        """
        where, _, today = describe_machine(device).rpartition("; ")
        return Origin(self.version, where, self.digest, today)


def measure_figure(figure: Figure, run: Run, previous: Entry | None, on_line: Callable[[str], object]) -> Entry:
    """Return the earlier entry of a figure if it has these numbers or none can be measured here, else a new one.

    `on_line` is as in `run_command`.
    """
    command = format_command(figure, run.is_quick)
    try:
        origin, reason = run.build_origin(figure.device), _not_installed(figure)
    except InputError as error:
        origin, reason = run.build_origin("auto"), str(error)
    entry = Entry(figure.name, command, "skipped", (), reason, 0.0, origin)
    if previous is not None and previous.values and (reason or _same(previous, entry)):
        return previous
    return entry if reason else _measured(figure, run, entry, on_line)


def _not_installed(figure: Figure) -> str:
    gone = [name for name in figure.modules if find_spec(name) is None]
    return f"{', '.join(gone)} not installed. {install_hint('peers')}" if gone else ""


def _same(before: Entry, now: Entry) -> bool:
    """Return True if both entries have the same command and origin, dates aside."""
    return before.command == now.command and replace(before.origin, date=now.origin.date) == now.origin


def _measured(figure: Figure, run: Run, entry: Entry, heard: Callable[[str], object]) -> Entry:
    """Measure a figure in a separate process; return the entry with its numbers, or the reason of a failure."""
    words = build_arguments(figure, run.is_quick, None if run.anatomy is None else str(run.anatomy.absolute()))
    with TemporaryDirectory() as folder:
        ended = run_command((*run.command, *words, "--json"), Path(folder), heard)
    values, reason = _values(figure, ended)
    state = "failed" if not values else "missed" if reason else "measured"
    return replace(entry, state=state, values=values, reason=reason, seconds=ended.seconds)


def _values(figure: Figure, ended: ProcessResult) -> tuple[tuple[Value, ...], str]:
    """Return the numbers in a process's output, and the reason if some are missing or it failed; else empty."""
    lines = ended.output.strip().splitlines()
    try:
        said = json.loads(lines[-1])
    except (ValueError, IndexError, RecursionError):
        said = None
    found = [(reading, read_number(said, reading.place)) for reading in figure.readings]
    values = tuple(Value(it.name, number, it.unit, it.better) for it, number in found if number is not None)
    gone = [reading.name for reading, number in found if number is None]
    if ended.code:
        return values, _why(ended, bool(values))
    if gone:
        return values, f"its JSON has no number for {', '.join(gone)}"[:LONGEST]
    return values, ""


def _why(ended: ProcessResult, has_numbers: bool) -> str:
    """Return the reason of a process's failure, without control characters."""
    if ended.code < 0:
        name = signal.strsignal(-ended.code) or f"signal {-ended.code}"
        return f"its process was ended ({name})" + (", as where memory runs out" if name == "Killed" else "")
    if ended.code == 1 and has_numbers:
        return "its command ended with 1: not all that it measures came out as it asks"
    said = "".join(letter if letter.isprintable() else " " for letter in ended.error)
    return f"its command ended with {ended.code}: {said or 'it said nothing'}"[:LONGEST]

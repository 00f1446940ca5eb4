"""Durations of tasks, stored next to the episodes, whose own bytes do not depend on the machine."""

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import explain_error

from .run_folder import RATES
from .tasks import TaskOutcome

COLUMNS = "kind,number,frames,bytes,seconds,first"  # Column names of the table of rates.


@dataclass(frozen=True)
class TaskRate:
    """Measured task: kind ("episode" or "body"), number, frames, size [bytes], and duration [s] in one worker.

    `first`, one of `tasks.FIRST`, is the task's position in the worker: first of the process, first on a body, or not.
    """

    kind: str
    number: int
    frames: int
    bytes: int
    seconds: float
    first: str


@contextmanager
def write_rates(folder: Path) -> Iterator[Callable[[str, TaskOutcome], None]]:
    """Yield a function that records completed tasks in a file of this process; resumed tasks are not recorded.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    now = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / RATES / f"{now}-{platform.node()}-{os.getpid()}.csv"
    try:
        file = path.open("a", buffering=1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({explain_error(error)}). Choose another folder for --out."
        ) from error
    with file:
        file.write(COLUMNS + "\n")

        def note(kind: str, one: TaskOutcome) -> None:
            if not (one.failed or one.skipped or one.resumed):
                file.write(f"{kind},{one.number},{one.frames},{one.bytes},{one.seconds:.4f},{one.first}\n")

        yield note


def read_rates(folder: Path) -> list[TaskRate]:
    """Read the task durations of a run folder; incomplete lines, which a killed process may leave, are skipped."""
    found = []
    for path in sorted((folder / RATES).glob("*.csv")):
        for line in path.read_text(errors="replace").splitlines(keepends=True):
            words = line.rstrip("\n").split(",")
            try:
                if line.endswith("\n"):
                    kind, number, frames, size, seconds, first = words
                    found.append(TaskRate(kind, int(number), int(frames), int(size), float(seconds), first))
            except ValueError:
                continue
    return found

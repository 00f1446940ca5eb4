"""Child processes: a crash or lack of memory ends the child alone."""

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HOUSE = Path(__file__).parents[2]
POLL = 0.5
"""Interval at which a process's output is read [s]."""


@dataclass(frozen=True)
class ProcessResult:
    """Ended process: exit code, output, last line of its standard error, and duration [s]."""

    code: int
    output: str
    error: str
    seconds: float


def build_environment(variables: Mapping[str, str] | None = None) -> dict[str, str]:
    """Build the environment of a process that imports this copy of the package, with `variables` variables."""
    paths = [str(HOUSE), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, **(variables or {}), "PYTHONPATH": os.pathsep.join(paths)}


def start_program(command: Sequence[str], variables: Mapping[str, str], **streams: Any) -> subprocess.Popen[str]:
    """Start a program in a separate session, so that `stop_program` also ends its children."""
    environment = build_environment(variables)
    return subprocess.Popen(command, env=environment, start_new_session=True, text=True, **streams)


def stop_program(child: subprocess.Popen[str]) -> None:
    """End a program and all processes of its session."""
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.communicate()


def run_command(command: Sequence[str], folder: Path, on_line: Callable[[str], object]) -> ProcessResult:
    """Run a command in a folder to its end, then end its children.

    Parameters
    ----------
    on_line
        Receives each line that the command writes to its standard error; an empty line: the command still runs.
    """
    begun, complaint, left = time.perf_counter(), "", ""
    output, complaints = folder / "output.txt", folder / "complaints.txt"
    with output.open("wb") as out, complaints.open("wb") as err, complaints.open(errors="replace") as said:
        variables = {"TQDM_MININTERVAL": "10"}
        child = start_program(command, variables, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        try:
            running = True
            while running:
                with suppress(subprocess.TimeoutExpired):
                    child.wait(POLL)
                    running = False
                *lines, left = re.split(r"[\r\n]", left + said.read() + "\n" * (not running))
                for line in ["", *filter(str.strip, lines)]:
                    on_line(line)
                    complaint = line.strip() or complaint
        finally:
            stop_program(child)
    return ProcessResult(child.returncode, output.read_text(errors="replace"), complaint, time.perf_counter() - begun)

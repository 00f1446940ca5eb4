"""Tasks of a worker: one body or one episode, and their outcome."""

import errno
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sim.errors import InputError
from sim.runtime.threads import limit_to_one_thread

from .run_folder import RunSettings, describe_other_versions, get_versions, read_run

DISK_FULL_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""Errors that would occur in every other episode, too."""
FIRST = FIRST_OF_PROCESS, FIRST_OF_BODY, NOT_FIRST = "process", "body", "no"
"""Values of `first`: first task of its kind by a process; first on its body by a process; neither."""


@dataclass(frozen=True)
class MadeEpisode:
    """Outcome of making an episode or a body.

    Parameters
    ----------
    path
        Path of the file or folder.
    frames, bytes
        Number of frames, and size [bytes].
    failed
        Reason of a failure; empty on success.
    skipped
        True if the result existed before.
    resumed
        True if a part of it existed before.
    """

    path: Path
    frames: int = 0
    bytes: int = 0
    failed: str = ""
    skipped: bool = False
    resumed: bool = False


@dataclass(frozen=True)
class RunWork:
    """Functions that make bodies and episodes: module-level (or partials), so that workers can import them.

    Parameters
    ----------
    body_of
        Function from an episode's number to that of its body.
    make_body, make_episode
        Functions that make the item of a number, or find the existing one.
    """

    body_of: Callable[[int], int]
    make_body: Callable[[int], MadeEpisode]
    make_episode: Callable[[int], MadeEpisode]


@dataclass(frozen=True)
class TaskOutcome:
    """Outcome of one task.

    Parameters
    ----------
    seconds
        Duration [s].
    failed
        Reason of a failure.
    lost
        True if another attempt may succeed.
    skipped
        True if the result existed.
    halt
        Reason why no other task can succeed.
    resumed
        True if a part of it existed.
    first
        First task of its kind by its worker, which loads and compiles: one of `FIRST`.
    """

    number: int
    frames: int = 0
    bytes: int = 0
    seconds: float = 0.0
    failed: str = ""
    lost: bool = False
    skipped: bool = False
    halt: str = ""
    resumed: bool = False
    first: str = NOT_FIRST


class _Process:
    """State of this process: what it has made, and whether its GPU has failed, so that its results are unreliable."""

    made: ClassVar[set[object]] = set()
    spoilt = False


def try_task(
    make: Callable[[int], MadeEpisode], number: int, folder: Path, run: RunSettings, body: TaskOutcome | None = None
) -> TaskOutcome:
    """Make item `number`, if the worker can access the run's folder and has the run's versions.

    Raises
    ------
    Exception
        See `make`; another attempt may succeed. On a GPU, errors not caused by the input make the process
        unusable: it ends itself at its next task.
    """
    if _Process.spoilt:
        os._exit(1)
    halt = _explain_unfit_worker(folder, run)
    if halt:
        return TaskOutcome(number, halt=halt)
    if body is not None and (body.failed or body.halt):
        return TaskOutcome(number, failed=body.failed and f"its body {body.number}: {body.failed}", halt=body.halt)
    begun = time.perf_counter()
    try:
        with limit_to_one_thread():
            made = make(number)
    except Exception as error:
        if _is_full(error):
            return TaskOutcome(number, halt=str(error))
        _Process.spoilt = run.device == "cuda" and not isinstance(error, InputError | OSError)
        raise
    seconds, kind = time.perf_counter() - begun, getattr(make, "func", make)
    on_body = kind, None if body is None else body.number
    first = FIRST_OF_PROCESS if kind not in _Process.made else NOT_FIRST if on_body in _Process.made else FIRST_OF_BODY
    if not (made.failed or made.skipped):
        _Process.made |= {kind, on_body}
    return TaskOutcome(
        number, made.frames, made.bytes, seconds, made.failed, skipped=made.skipped, resumed=made.resumed, first=first
    )


def _explain_unfit_worker(folder: Path, run: RunSettings) -> str:
    """Return the reason why this worker cannot take part in the run; empty if it can."""
    here = platform.node()
    other = describe_other_versions(get_versions(), run.versions)
    if other:
        return f"the worker on {here} has {other}. Install the same there."
    found = read_run(folder)
    if found is None:
        return f"the worker on {here} does not see {folder}. Give all machines one folder under the same name."
    if (found.digest, found.seed) != (run.digest, run.seed):
        return f"{folder}: is that of another plan or seed by now, as the worker on {here} sees it."
    return ""


def _is_full(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False

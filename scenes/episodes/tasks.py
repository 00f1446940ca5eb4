"""Tasks of a worker, which make one body or one episode, and their outcomes."""

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
"""Error numbers of a full or read-only disk, which would occur in all other episodes too."""
FIRST = FIRST_OF_PROCESS, FIRST_OF_BODY, NOT_FIRST = "process", "body", "no"
"""Values of `first`: first task of its kind in a process, first task on a body in a process, or neither."""


@dataclass(frozen=True)
class MadeEpisode:
    """Result of making an episode or a body.

    Parameters
    ----------
    path
        Path of the episode's file or the body's folder.
    frames, bytes
        Number of frames, and size [bytes].
    failed
        Reason of a failure; empty on success.
    skipped
        True if the result existed before.
    resumed
        True if a part of the result existed before.
    """

    path: Path
    frames: int = 0
    bytes: int = 0
    failed: str = ""
    skipped: bool = False
    resumed: bool = False


@dataclass(frozen=True)
class RunWork:
    """Functions that make bodies and episodes; workers must be able to import them (module-level or partial).

    Parameters
    ----------
    body_of
        Function from an episode's number to the number of its body.
    make_body, make_episode
        Functions that make the body or the episode of a number, unless it exists.
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
    """State of this process: tasks made here, and True in `spoilt` after a GPU error, which may spoil results."""

    made: ClassVar[set[object]] = set()
    spoilt = False


def try_task(
    make: Callable[[int], MadeEpisode], number: int, folder: Path, run: RunSettings, body: TaskOutcome | None = None
) -> TaskOutcome:
    """Make item `number` with `make`, if the worker has access to the run's folder and the run's versions.

    Raises
    ------
    Exception
        Any exception of `make`; another attempt may succeed. After an exception on a GPU other than InputError and
        OSError, the process is unusable, and ends at its next task.
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


def _explain_unfit_worker(folder: Path, run_settings: RunSettings) -> str:
    """Return the reason why this worker cannot work for the run; empty if it can."""
    here = platform.node()
    other = describe_other_versions(get_versions(), run_settings.versions)
    if other:
        return f"the worker on {here} has {other}. Install the same there."
    found = read_run(folder)
    if found is None:
        return f"the worker on {here} does not see {folder}. Give all machines one folder under the same name."
    if (found.digest, found.seed) != (run_settings.digest, run_settings.seed):
        return f"{folder}: is that of another plan or seed by now, as the worker on {here} sees it."
    return ""


def _is_full(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False

"""Scheduling of episodes on many workers, until all episodes exist or have failed."""

from __future__ import annotations

import random
import shlex
from collections.abc import Callable, Iterator, Sequence, Set
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Protocol
from uuid import uuid4

from distributed import Future
from distributed.scheduler import KilledWorker

from sim.errors import InputError

from .run_folder import Failure, RunSettings, list_failed, list_failures, mark_failed, remove_failure, to_episode_name
from .tasks import MadeEpisode, RunWork, TaskOutcome, try_task
from .workers import MAX_WORKER_DEATHS, Workers, describe_scheduler_end

MAX_RETRIES = 3
"""Number of retries of a task that raises an error."""
TASKS_PER_WORKER = 3
"""Number of episodes that are assigned to each worker at a time, so that no worker is idle."""
POLL_INTERVAL = 1.0
"""Interval at which the workers are counted [s]."""
EPISODE, BODY = "episode", "body"
"""Kinds of tasks."""
GRACE_TIME = 60
"""Time between the warning signal and the end of a job [s]."""


class ProgressListener(Protocol):
    """Protocol of a callback for finished tasks and for the number of workers; `outcome` is None without a task."""

    def __call__(self, kind: str, outcome: TaskOutcome | None, workers: int) -> object:
        """Receive the outcome of a task of this kind, and the current number of workers."""
        ...


@dataclass(frozen=True)
class RunStatistics:
    """Statistics of a run: numbers of episodes made now, present before, failed permanently, and failed temporarily.

    `frames` and `bytes` are the totals of the episodes made now.
    """

    made: int = 0
    skipped: int = 0
    failed: int = 0
    lost: int = 0
    frames: int = 0
    bytes: int = 0

    def add(self, outcome: TaskOutcome) -> RunStatistics:
        """Return the statistics with the outcome of one more episode."""
        if outcome.failed:
            return replace(self, lost=self.lost + 1) if outcome.lost else replace(self, failed=self.failed + 1)
        if outcome.skipped:
            return replace(self, skipped=self.skipped + 1)
        frames, size = self.frames + outcome.frames, self.bytes + outcome.bytes
        return replace(self, made=self.made + 1, frames=frames, bytes=size)


def list_missing_episodes(
    folder: Path, existing: Set[int], numbers: range, is_first_client: bool, with_failed: bool = False
) -> tuple[RunStatistics, list[int]]:
    """Count the episodes that exist or have failed permanently, and list the missing episodes in order of execution.

    The order is ascending for the first client and random for later clients, so that two clients of a folder seldom
    make the same episode at the same time. If they do, one client overwrites the file with the same bytes.

    Parameters
    ----------
    existing
        Numbers of all existing episodes in the folder.
    with_failed
        True to retry episodes that have failed permanently.
    """
    there = existing & set(numbers)
    gone = set() if with_failed else {number for number, one in list_failures(folder).items() if not one.lost}
    gone = gone.intersection(numbers) - there
    missing = [number for number in numbers if number not in there and number not in gone]
    if not is_first_client:
        random.shuffle(missing)
    return RunStatistics(skipped=len(there), failed=len(gone)), missing


def make_episodes(
    work: RunWork,
    folder: Path,
    run: RunSettings,
    numbers: Sequence[int],
    workers: Workers,
    listener: ProgressListener,
    statistics: RunStatistics,
) -> RunStatistics:
    """Make the missing episodes, each after its body, and record failures in the folder; return the totals.

    Parameters
    ----------
    statistics
        Initial totals, to which outcomes are added.

    Raises
    ------
    InputError
        A worker has no access to the folder or other versions, the disk is full, or the scheduler ended.
    """
    ended: SimpleQueue[Future] = SimpleQueue()
    busy: dict[str, tuple[str, int, Future]] = {}
    bodies: dict[int, Future] = {}
    failed_before, token = list_failed(folder), uuid4().hex
    tally, count, counted = statistics, workers.count(), monotonic()

    def submit(kind: str, number: int, make: Callable[[int], MadeEpisode], *dependencies: Future) -> Future:
        future = workers.client.submit(
            try_task, make, number, folder, run, *dependencies,
            key=f"{kind}-{number}-{token}", retries=MAX_RETRIES, resources=workers.needs,
        )  # fmt: skip
        busy[str(future.key)] = kind, number, future
        future.add_done_callback(ended.put)
        return future

    def record(kind: str, outcome: TaskOutcome) -> None:
        nonlocal tally
        if outcome.halt:
            raise InputError(outcome.halt)
        listener(kind, outcome, count)
        if kind == BODY:
            return
        tally = tally.add(outcome)
        if outcome.failed:
            mark_failed(folder, Failure(outcome.number, outcome.failed, outcome.lost))
        elif outcome.number in failed_before:
            remove_failure(folder, outcome.number)

    def list_missing() -> Iterator[int]:
        for number in numbers:
            if (folder / to_episode_name(number)).exists():  # another client made it meanwhile
                record(EPISODE, TaskOutcome(number, skipped=True))
            else:
                yield number

    waiting = list_missing()
    try:
        while True:
            handed_out = sum(kind == EPISODE for kind, _, _ in busy.values())
            for number in islice(waiting, max(0, TASKS_PER_WORKER * max(count, 1) - handed_out)):
                body = work.body_of(number)
                if body not in bodies:
                    bodies[body] = submit(BODY, body, work.make_body)
                submit(EPISODE, number, work.make_episode, bodies[body])
            if not busy:
                return tally
            for future, outcome in _collect_outcomes(_collect_ended_futures(ended), workers, ended):
                kind, number, _ = busy.pop(str(future.key))
                record(kind, replace(outcome, number=number))
            if monotonic() - counted > POLL_INTERVAL:
                count, counted = workers.count(), monotonic()
                listener(EPISODE, None, count)
    finally:
        if workers.client.status == "running":
            workers.client.cancel([future for _, _, future in busy.values()])


def _collect_ended_futures(ended_queue: SimpleQueue[Future]) -> list[Future]:
    """Return all ended futures; wait for the first future for at most `POLL_INTERVAL`."""
    found = []
    try:
        found.append(ended_queue.get(timeout=POLL_INTERVAL))
        while True:
            found.append(ended_queue.get_nowait())
    except Empty:
        return found


def _collect_outcomes(
    futures: Sequence[Future], workers: Workers, ended_queue: SimpleQueue[Future]
) -> Iterator[tuple[Future, TaskOutcome]]:
    """Yield finished tasks with their outcomes; a task whose result was lost with its worker will finish again."""
    for future in futures:
        if future.status == "error":
            yield future, TaskOutcome(0, failed=_describe_failure(future.exception()), lost=True)
            continue
        try:  # briefly, as the worker may have to be restarted
            outcome = future.result(timeout=POLL_INTERVAL)
        except TimeoutError:
            future.add_done_callback(ended_queue.put)
        except CancelledError as error:  # state of all futures when the scheduler is gone
            raise describe_scheduler_end(workers.description) from error
        else:
            yield future, outcome


def _describe_failure(error: object) -> str:
    if isinstance(error, KilledWorker):
        return f"its worker was killed {MAX_WORKER_DEATHS} times, probably out of memory"
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"


def write_sbatch_script(command: Sequence[str], machines: int, device: str, name: str) -> str:
    """Return the text of a script for `sbatch`: an array of jobs that work in one folder without communication.

    A job that ends early is queued again and resumes. No network port is opened between machines.

    Parameters
    ----------
    command
        Command that each job runs, without --workers.
    machines
        Number of jobs in the array.
    device
        "cpu": one process per core of the job. "cuda": 1.5 processes per core, which share the job's GPU.
    name
        Name of the job.
    """
    on_card = device == "cuda"
    # A process takes 1 to 3 GB.
    asked = ["--gpus-per-task=1", "--mem-per-cpu=5G"] if on_card else ["--mem-per-cpu=4G"]
    workers = "$((SLURM_CPUS_PER_TASK * 3 / 2))" if on_card else "$SLURM_CPUS_PER_TASK"
    options = [
        f"--job-name={name}",
        f"--array=1-{machines}",
        "--ntasks=1",
        "--cpus-per-task=16",
        *asked,
        "--time=24:00:00",
        "--requeue",
        "--open-mode=append",
        f"--signal=B:TERM@{GRACE_TIME}",
    ]
    return "\n".join(
        [
            "#!/bin/bash",
            *(f"#SBATCH {option}" for option in options),
            "# Every job gives the same command: what is there is skipped, and what is missing is made.",
            f'exec {shlex.join(command)} --workers "{workers}"',
            "",
        ]
    )

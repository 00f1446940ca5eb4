"""Episodes looked at in processes of their own: a file that ends the process that reads it ends no other."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

from sim.errors import InputError
from sim.runtime.device import find_device
from sim.runtime.file_limits import at_most

from .validation import Report, validate_episode

# Bytes that looking at one file may take.
MOST_BYTES = 8 * 1024**3


def validated(
    paths: Sequence[Path], workers: int, look: Callable[[Path], Report] = validate_episode
) -> Iterator[Report]:
    """A report of each file, as they come; `workers` processes at a time.

    What a process that was lost had begun is looked at again, each file alone.
    """
    left = list(dict.fromkeys(paths))
    try:
        with _pool(workers) as pool:
            try:
                for done in as_completed([pool.submit(_looked_at, look, path) for path in left]):
                    report = done.result()
                    left.remove(report.path)
                    yield report
            except BaseException:  # Ctrl-C, or a reader that wants no more: what has not begun is not begun
                pool.shutdown(cancel_futures=True)
                raise
    except BrokenProcessPool:
        for path in left:
            yield _alone(look, path)


def _alone(look: Callable[[Path], Report], path: Path) -> Report:
    try:
        with _pool(1) as pool:
            return pool.submit(_looked_at, look, path).result()
    except BrokenProcessPool:
        return Report(path, ["it ends the process that reads it: it is damaged. Make it anew, or leave it out."])


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN))


def _looked_at(look: Callable[[Path], Report], path: Path) -> Report:
    find_device("cpu", "float32")  # which keeps Warp's notes out of what is reported
    try:
        with at_most(MOST_BYTES):
            return look(path)
    except InputError as error:
        return Report(path, [str(error)])

"""Episodes looked at in processes of their own: a file that ends the process that reads it ends no other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from sim.errors import InputError
from sim.runtime.device import find_device
from sim.runtime.file_limits import at_most
from sim.runtime.processes import LostError, map_apart

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
    look_at = partial(_looked_at, look)
    try:
        for path, report in map_apart(look_at, tuple(left), workers):
            left.remove(path)
            yield report
    except LostError:
        for path in left:
            try:
                yield from (report for _, report in map_apart(look_at, [path]))
            except LostError:
                yield Report(path, ["it ends the process that reads it: it is damaged. Make it anew, or leave it out."])


def _looked_at(look: Callable[[Path], Report], path: Path) -> Report:
    find_device("cpu", "float32")  # which keeps Warp's notes out of what is reported
    try:
        with at_most(MOST_BYTES):
            return look(path)
    except InputError as error:
        return Report(path, [str(error)])

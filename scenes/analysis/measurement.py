"""Measurement of wall time and memory, description of the machine, and CSV tables of results."""

import csv
import os
import platform
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import warp as wp

from sim.runtime.atomic_files import write_atomically
from sim.runtime.device import find_device
from sim.runtime.versions import get_version


def describe_machine(device: str) -> str:
    """Describe the machine's hardware, software versions and the date in one line.

    Raises
    ------
    InputError
        This machine does not have the device.
    """
    names = [wp.get_device(find_device(device, "float32").name).name]
    try:
        with open("/proc/cpuinfo") as file:
            names += [line.split(":")[1].strip() for line in file if line.startswith("model name")][:1]
    except OSError:
        names.append(platform.processor())
    versions = ", ".join(f"{name} {get_version(name)}" for name in ("sulcus", "warp-lang", "torch", "numpy"))
    return (
        f"{' / '.join(names)}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}; {date.today()}"
    )


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV table atomically, with a line for each row and a column for each name that occurs in any row."""
    names = dict.fromkeys(name for row in rows for name in row)
    with write_atomically(path, ".csv") as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(names))
        writer.writeheader()
        writer.writerows(rows)


def measure_peak_memory() -> float | None:
    """Return the peak resident memory of this process [GiB]; None on systems other than Linux."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM:")), None)


@contextmanager
def watch_gpu_memory(device: str) -> Iterator[list[int]]:
    """Yield a list that collects the additionally used GPU memory [bytes] during the block; only 0 without a GPU."""
    where = wp.get_device(None if device == "auto" else device)
    taken = [0]
    if not where.is_cuda:
        yield taken
        return
    before, ended = where.free_memory, threading.Event()

    def record_memory() -> None:
        while not ended.wait(0.02):
            taken.append(before - where.free_memory)

    watcher = threading.Thread(target=record_memory, daemon=True)
    watcher.start()
    try:
        yield taken
    finally:
        ended.set()
        watcher.join()


P = ParamSpec("P")  # Parameters of the timed function.
T = TypeVar("T")  # Result of the timed function.


def time_work(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[T, float]:
    """Return the result of `work` and its wall time [s]; the GPU is synchronised before and after the work."""
    wp.synchronize()
    begun = time.perf_counter()
    found = work(*args, **kwargs)
    wp.synchronize()
    return found, time.perf_counter() - begun

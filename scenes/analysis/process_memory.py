"""Peak memory of this process, and of what it takes of a graphics card."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import warp as wp


def peak_memory() -> float | None:
    """The largest resident size of this process so far [GiB], as Linux reports it."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM:")), None)


@contextmanager
def watched_card(device: str) -> Iterator[list[int]]:
    """The bytes of the card that are taken while the block runs, beyond those taken before; zero without a card."""
    where = wp.get_device(None if device == "auto" else device)
    taken = [0]
    if not where.is_cuda:
        yield taken
        return
    before, ended = where.free_memory, threading.Event()

    def watch() -> None:
        while not ended.wait(0.02):
            taken.append(before - where.free_memory)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield taken
    finally:
        ended.set()
        watcher.join()

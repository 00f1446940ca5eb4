"""Wall time of stages, reported to active listeners."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

_listening: list[dict[str, float]] = []  # Seconds by stage of each active listener.


@contextmanager
def time_stage(name: str) -> Iterator[None]:
    """Add the wall time [s] of the block to the stage `name` of every listener; stages are not nested."""
    began = time.perf_counter()
    try:
        yield
    finally:
        for seconds in _listening:
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - began


@contextmanager
def listen_to_stages() -> Iterator[dict[str, float]]:
    """Yield a dictionary of the seconds of each stage inside the block, in the order in which stages first end."""
    seconds: dict[str, float] = {}
    _listening.append(seconds)
    try:
        yield seconds
    finally:
        _listening.pop()

"""Wall time of a call; the device is waited for."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import warp as wp

P = ParamSpec("P")
T = TypeVar("T")


def timed(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[T, float]:
    """What `work` returns, and the wall seconds that it took; the device is waited for at both readings."""
    wp.synchronize()
    begun = time.perf_counter()
    found = work(*args, **kwargs)
    wp.synchronize()
    return found, time.perf_counter() - begun

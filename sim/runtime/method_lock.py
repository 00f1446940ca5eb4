"""Mutual exclusion of threads in methods that work on their object's arrays."""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Locked(Protocol):
    """Object with a reentrant lock."""

    lock: RLock


def lock_method(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Return a method of a `Locked` that holds its lock: other threads wait until it returns."""

    @wraps(method)
    def held(self: Locked, *args: P.args, **kwargs: P.kwargs) -> R:
        with self.lock:
            return method(self, *args, **kwargs)

    return held

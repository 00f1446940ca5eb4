"""Mutual exclusion of threads in methods that change the arrays of their object."""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Locked(Protocol):
    """Interface of objects with a reentrant lock."""

    lock: RLock


def lock_method(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Return a method of a `Locked` object that holds the lock; other threads wait until the method returns."""

    @wraps(method)
    def run_locked(self: Locked, *args: P.args, **kwargs: P.kwargs) -> R:
        with self.lock:
            return method(self, *args, **kwargs)

    return run_locked

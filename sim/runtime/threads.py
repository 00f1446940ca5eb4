"""One thread of BLAS: on small matrices several wait for one another, ages where something else runs on their cores."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock

from threadpoolctl import ThreadpoolController

# Who is inside, as the limit is the whole process's: a page and its finite elements are two threads of it.
_lock, _inside = Lock(), []


@cache
def _loaded() -> ThreadpoolController:
    """The libraries that are loaded: to look for them takes a millisecond, to tell them a hundredth."""
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """While anyone is in it, the libraries that were loaded when it was first entered use one thread.

    The first who enters tells them, the last who leaves gives them back what they had: what is computed inside has the
    same bits whoever else comes and goes.
    """
    with _lock:
        _inside.append(_inside[0] if _inside else _loaded().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()

"""Threads: BLAS held to one, where several would wait for one another, and native loops on several cores at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from queue import SimpleQueue
from threading import Lock, Thread

from threadpoolctl import ThreadpoolController

# Who is inside, as the limit is the whole process's: a page and its finite elements are two threads of it.
_lock, _inside = Lock(), []


@cache
def _loaded() -> ThreadpoolController:
    """Return the libraries that are loaded: to look for them takes a millisecond, to tell them a hundredth."""
    return ThreadpoolController()


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
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


Task = Callable[[], object]


@dataclass(frozen=True)
class Sharing:
    """When native loops are divided among threads.

    Parameters
    ----------
    most
        Threads; more share one memory, and were not measured.
    least
        Elements or unknowns: to hand fewer over takes longer, a tenth of a millisecond, than they do.
    """

    most: int = 2
    least: int = 3000


def choose_threads(work: int, sharing: Sharing = Sharing()) -> int:
    """How many threads native loops over so many elements or unknowns are divided among."""
    if work < sharing.least:
        return 1
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(sharing.most, here)


def run_together(tasks: Sequence[Task]) -> None:
    """Run tasks at the same time, the first on this thread; back when all have ended. None may call this in its turn.

    Threads stay, waiting at a queue: a pool's futures cost four times as long, which a task of a millisecond feels.
    """
    ended: SimpleQueue[BaseException | None] = SimpleQueue()
    for number, task in enumerate(tasks[1:]):
        _waiting(number).put((task, ended))
    try:
        tasks[0]()
    finally:
        errors = [ended.get() for _ in tasks[1:]]
    for error in filter(None, errors):
        raise error


@cache
def _waiting(number: int) -> SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]]:
    """Return the queue of the thread with this number."""
    queue: SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]] = SimpleQueue()
    Thread(target=_serve, args=(queue,), name=f"sulcus {number}", daemon=True).start()
    return queue


# A forked process has the queues without the threads that wait at them.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_waiting.cache_clear)


def _serve(queue: SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]]) -> None:
    while True:
        task, ended = queue.get()
        try:
            task()
        except BaseException as error:  # whoever waits raises it
            ended.put(error)
        else:
            ended.put(None)

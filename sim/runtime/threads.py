"""Control of threads: BLAS limited to one thread if several would wait for each other; native loops on several."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from queue import SimpleQueue
from threading import Event, Lock, Thread, local

from threadpoolctl import ThreadpoolController

# Active blocks of all threads: the limit applies to the whole process, for example to a page and its FEM solver.
_lock, _inside = Lock(), []


@cache
def _get_controller() -> ThreadpoolController:
    """Return the cached controller of the loaded libraries; the search takes 1 ms, a limit 0.01 ms."""
    return ThreadpoolController()


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit BLAS to one thread during the block, in the libraries loaded at the first call of this function.

    The first active block sets the limit, and the last block restores the previous limit. Results inside a block are
    bitwise the same, independent of other threads.
    """
    with _lock:
        _inside.append(_inside[0] if _inside else _get_controller().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()


MAX_PAUSE = 0.1  # Longest pause of a background thread before a kernel [s].
_thread, _is_idle = local(), Event()
_is_idle.set()


@contextmanager
def run_in_foreground() -> Iterator[None]:
    """Pause the kernels of background threads during the block, since Python threads delay each other at each call."""
    _is_idle.clear()
    try:
        yield
    finally:
        _is_idle.set()


def enter_background() -> None:
    """Mark this thread as background: its kernels wait while another thread is inside `run_in_foreground`."""
    _thread.background = True


def wait_for_foreground() -> None:
    """Pause a background thread while another thread is in the foreground."""
    if getattr(_thread, "background", False):
        _is_idle.wait(MAX_PAUSE)


Task = Callable[[], object]  # Function to run on a thread.


@dataclass(frozen=True)
class ThreadLimits:
    """Limits for the distribution of native loops to threads.

    Parameters
    ----------
    max_threads
        Maximum number of threads; more threads would share the memory bandwidth, and were not measured.
    min_size
        Minimum number of elements or unknowns: for fewer, the start of threads (0.1 ms) takes longer than the loop.
    """

    max_threads: int = 2
    min_size: int = 3000


def count_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def choose_threads(size: int, limits: ThreadLimits = ThreadLimits()) -> int:
    """Return the number of threads for a native loop over `size` elements or unknowns."""
    if size < limits.min_size:
        return 1
    return min(limits.max_threads, count_cores())


def run_concurrently(tasks: Sequence[Task]) -> None:
    """Run tasks at the same time, the first task on this thread, and wait for all. No task may call this function.

    Reused threads wait at a queue; the futures of a pool would take four times as long, too long for tasks of 1 ms.
    """
    ended: SimpleQueue[BaseException | None] = SimpleQueue()
    for number, task in enumerate(tasks[1:]):
        _get_queue(number).put((task, ended))
    try:
        tasks[0]()
    finally:
        errors = [ended.get() for _ in tasks[1:]]
    for error in filter(None, errors):
        raise error


@cache
def _get_queue(thread_number: int) -> SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]]:
    """Return the queue of the thread with this number."""
    queue: SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]] = SimpleQueue()
    Thread(target=_run_tasks, args=(queue,), name=f"sulcus {thread_number}", daemon=True).start()
    return queue


# A forked process inherits the queues without their threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_get_queue.cache_clear)


def _run_tasks(queue: SimpleQueue[tuple[Task, SimpleQueue[BaseException | None]]]) -> None:
    while True:
        task, ended = queue.get()
        try:
            task()
        except BaseException as error:  # raised by the waiting thread
            ended.put(error)
        else:
            ended.put(None)

"""Termination of commands by Ctrl-C or SIGTERM, even during a long computation."""

import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from types import FrameType

# Exit codes after Ctrl-C (a normal end) and SIGTERM (the shell's code).
EXIT_CODES = {signal.SIGINT: 0, signal.SIGTERM: 128 + signal.SIGTERM}
INTERRUPTED_CODE = (
    128 + signal.SIGINT
)  # Exit code of a command that Ctrl-C stops during its work and that can be resumed.
MAX_CLEANUP_TIME = 0.3  # Maximum time for cleaning up after a signal [s].
# Polling interval of the main thread [s]: a signal may be delivered to another thread, which does not wake it.
POLL_INTERVAL = 0.1


class EndedBySignal(BaseException):
    """Exception that a signal raises in the main thread; `code` is the exit code."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal_number)
        self.code = EXIT_CODES[signal.Signals(signal_number)]


def run_until_signal(work: Callable[[ExitStack], int]) -> int:
    """Run `work`, clean up and return its result; at a signal, clean up and exit the process immediately.

    The work runs in its own thread, so that the main thread can receive signals during long calls. Results of a
    computation that a signal interrupts are lost; no file must be open for writing.

    Parameters
    ----------
    work
        Function that registers its cleanup on the exit stack that it receives, and returns the exit code.
    """
    closing = ExitStack()
    if threading.current_thread() is not threading.main_thread():
        with closing:
            return work(closing)
    result: Future[int] = Future()
    before = {number: signal.getsignal(number) for number in EXIT_CODES}
    try:
        for number in EXIT_CODES:
            signal.signal(number, raise_on_signal)
        worker = threading.Thread(target=fulfil_work, args=(result, work, closing), name="work", daemon=True)
        worker.start()
        while worker.is_alive():
            worker.join(POLL_INTERVAL)
        return result.result()
    except EndedBySignal as ended:
        for number in EXIT_CODES:
            signal.signal(number, signal.SIG_IGN)
        cleaner = threading.Thread(target=closing.close, name="closing", daemon=True)
        cleaner.start()
        cleaner.join(MAX_CLEANUP_TIME)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(ended.code)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interrupt_on_termination() -> Iterator[Callable[[], None]]:
    """Raise KeyboardInterrupt at SIGTERM as at Ctrl-C, so that the block is cleaned up; yield a function to poll.

    Python ignores exceptions in finalisers, so that a signal during a finaliser is repeated later. Long work should
    also call the yielded function regularly, which raises KeyboardInterrupt after a signal.
    """
    came, over = threading.Event(), threading.Event()

    def receive_input(number: int, frame: FrameType | None) -> None:
        came.set()
        if not _is_finalising(frame):
            raise KeyboardInterrupt
        again = threading.Timer(POLL_INTERVAL, lambda: over.is_set() or signal.pthread_kill(main, number))
        again.daemon = True
        again.start()

    def stop_if_asked() -> None:
        if came.is_set():
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield stop_if_asked
        return
    main = threading.get_ident()
    before = {number: signal.signal(number, receive_input) for number in EXIT_CODES}
    try:
        yield stop_if_asked
    finally:
        over.set()
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_finalising(frame: FrameType | None) -> bool:
    """Return True if a stack frame runs inside a finaliser or a callback of the garbage collector."""
    while frame is not None:
        if frame.f_code.co_name in ("__del__", "_gc_callback") or frame.f_code.co_filename == weakref.__file__:
            return True
        frame = frame.f_back
    return False


def raise_on_signal(signal_number: int, frame: FrameType | None) -> None:
    """Handle a signal: raise `EndedBySignal` in the main thread."""
    raise EndedBySignal(signal_number)


def fulfil_work(future: Future[int], work: Callable[[ExitStack], int], exit_stack: ExitStack) -> None:
    """Run `work`, clean up, and store the return value or the exception in `future`."""
    try:
        with exit_stack:
            code = work(exit_stack)
    except BaseException as error:
        future.set_exception(error)
    else:
        future.set_result(code)

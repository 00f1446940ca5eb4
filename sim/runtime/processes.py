"""One process a device: each makes what it works with once, and then does one task after another."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from ..errors import InputError

Task = TypeVar("Task")
# How long a process that has closed its pipe may take to end [s].
PATIENCE = 5.0
VISIBLE = "CUDA_VISIBLE_DEVICES"
"""Which cards a process sees."""


class LostError(InputError):
    """A process that was ended, or whose card failed; what others did stays."""


@dataclass(frozen=True, eq=False)
class Child:
    """A process that works on a device, and the pipe to it."""

    device: str
    process: BaseProcess
    pipe: Any  # its class is another on Windows


@contextmanager
def working(devices: Sequence[str], make: Callable[..., Any], *given: Any) -> Iterator[tuple[Child, ...]]:
    """Processes, one on each of the devices, that have each made their `make(device, *given)`; killed at the end.

    They are spawned, so that `make` is a function of a module. None outlives this process, however that ends.

    Raises
    ------
    InputError
        What `make` raises.
    LostError
        A process that was ended.
    """
    with ExitStack() as closing:
        children = [_started(device, make, given, closing) for device in devices]
        for child in children:
            received(child)
        yield tuple(children)


def answers(
    children: Sequence[Child], work: Callable[[Any, Task], Any], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Any]]:
    """Each task with `work(made, task)`, as the answers come: the next task goes to the process that is free.

    Raises
    ------
    InputError
        What `work` raises.
    LostError
        A process that was ended. What others had ready is given before.
    """
    waiting, busy = iter(tasks), {}
    lost: Exception | None = None

    def busied(child: Child) -> None:
        for task in waiting:
            with suppress(BrokenPipeError, ConnectionResetError):  # to be noticed where its answer is read
                child.pipe.send((work, task))
            busy[child.pipe] = child, task
            return

    for child in children:
        busied(child)
    while busy:
        ready = wait(list(busy), 0.0 if lost else None)
        if not ready:
            break
        for pipe in ready:
            child, task = busy.pop(pipe)
            try:
                answer = received(child)
            except Exception as error:
                lost = lost or error
                continue
            if lost is None:
                busied(child)
            yield task, answer
    if lost is not None:
        raise lost


def at_once(children: Sequence[Child], work: Callable[[Any, Task], Any], tasks: Sequence[Task]) -> list[Any]:
    """What each process gives for its own of the tasks; all of them begin together.

    Raises
    ------
    InputError, LostError
        As `answers`.
    """
    for child, task in zip(children, tasks, strict=True):
        with suppress(BrokenPipeError, ConnectionResetError):
            child.pipe.send((work, task))
    found, lost = [], None
    for child in children:
        try:
            found.append(received(child))
        except Exception as error:
            lost = lost or error
    if lost is not None:
        raise lost
    return found


def received(child: Child) -> Any:
    """The next answer of a process.

    Raises
    ------
    LostError
        A process that was ended, or a card that failed.
    """
    try:
        answer = child.pipe.recv()
    except (EOFError, ConnectionResetError):
        child.process.join(PATIENCE)
        raise LostError(
            f"the process on {child.device} was ended{_why(child.process.exitcode)}. If that happens again, give "
            f"--device one {child.device} less."
        ) from None
    if not isinstance(answer, Exception):
        return answer
    if isinstance(answer, RuntimeError) and child.device.startswith("cuda"):  # what Warp and torch make of a card's
        reason = (str(answer).strip() or type(answer).__name__).splitlines()[0]
        raise LostError(
            f"{child.device} failed: {reason}. If that happens again, give --device one {child.device} less."
        ) from answer
    raise answer


def seen_as(device: str) -> str:
    """What a device is called by a process that from now on sees no other card."""
    kind, _, number = device.partition(":")
    if kind != "cuda" or number in ("", "0"):
        return device
    os.environ[VISIBLE] = card_of(number)
    return "cuda:0"


def card_of(number: str) -> str:
    """What a card that this process sees under a number is called in `VISIBLE`."""
    cards = os.environ.get(VISIBLE, "")
    return cards.split(",")[int(number)] if cards else number


def _started(device: str, make: Callable[..., Any], given: tuple[Any, ...], closing: ExitStack) -> Child:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, device, make, given), name=device, daemon=True)
    with uninterrupted():
        process.start()
    theirs.close()
    child = Child(device, process, ours)
    closing.callback(_end, child)
    return child


@contextmanager
def uninterrupted() -> Iterator[None]:
    """What is started here does not hear Ctrl-C, which the terminal gives to all: this process ends it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end(child: Child) -> None:
    child.process.kill()
    child.process.join()
    child.pipe.close()


def _serve(pipe: Any, device: str, make: Callable[..., Any], given: tuple[Any, ...]) -> None:
    """Make, and do tasks until the pipe ends; errors are answers too."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        made = _tried(make, seen_as(device), *given)
        pipe.send(made if isinstance(made, Exception) else None)
        while True:
            work, task = pipe.recv()
            pipe.send(_tried(work, made, task))


def _tried(function: Callable[..., Any], *given: Any) -> Any:
    """What a function gives, or what it raises, with its traceback as a note."""
    try:
        return function(*given)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error


def end_with_parent() -> None:
    """End this process when the one that started it ends; for a thread of its own."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _why(code: int | None) -> str:
    """How a process ended, in brackets."""
    if code is None or code == 0:
        return ""
    if code > 0:
        return f" (exit code {code})"
    name = signal.strsignal(-code) or f"signal {-code}"
    return f" ({name}), for want of memory most likely" if -code == signal.SIGKILL else f" ({name})"

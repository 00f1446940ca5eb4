"""Spawned processes: one that runs a function, and a pool with one on each device that does task after task."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import Pipe, get_context, parent_process
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from ..errors import InputError

Task = TypeVar("Task")
# How long a process that has closed its pipe may take to end [s].
PATIENCE = 5.0
VISIBLE = "CUDA_VISIBLE_DEVICES"
"""Variable of the cards that a process sees."""


class LostError(InputError):
    """A process that was ended, or whose card failed; what others did stays."""


@dataclass(frozen=True, eq=False)
class Child:
    """A process that works on a device, and the pipe to it."""

    device: str
    process: BaseProcess
    pipe: Any  # its class is another on Windows


def start_process(
    target: Callable[..., object], *given: Any, name: str, variables: Mapping[str, str] | None = None
) -> BaseProcess:
    """Start a spawned process that calls `target(*given)`, a function of a module.

    It ends with this process, however that ends, and ignores Ctrl-C, which the terminal gives to all: this process ends
    it. It finds the `variables` in its environment before it imports anything.
    """
    process = get_context("spawn").Process(target=_run, args=(target, given), name=name, daemon=True)
    with _environment(variables or {}), _interrupts_ignored():
        process.start()
    return process


@contextmanager
def process_pool(devices: Sequence[str], make: Callable[..., Any], *given: Any) -> Iterator[tuple[Child, ...]]:
    """Start a process on each of the devices, which calls `make(device, *given)`; all are killed at the end.

    Each sees its own card alone, as "cuda:0". `make` is a function of a module.

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
            _receive(child)
        yield tuple(children)


def map_apart(function: Callable[[Task], Any], tasks: Sequence[Task], count: int = 1) -> Iterator[tuple[Task, Any]]:
    """Yield each task with its result, as they come, from at most `count` processes that end with the last task.

    Raises
    ------
    InputError, LostError
        As `map_unordered`.
    """
    with process_pool(["cpu"] * min(count, len(tasks)), _second, function) as children:
        yield from map_unordered(children, _call, tasks)


def map_unordered(
    children: Sequence[Child], work: Callable[[Any, Task], Any], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Any]]:
    """Yield each task with `work(made, task)`, as they come: the next task goes to the process that is free.

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
                answer = _receive(child)
            except Exception as error:
                lost = lost or error
                continue
            if lost is None:
                busied(child)
            yield task, answer
    if lost is not None:
        raise lost


def run_on_each(children: Sequence[Child], work: Callable[[Any, Task], Any], tasks: Sequence[Task]) -> list[Any]:
    """Return result of each process for its own of the tasks; all of them begin together.

    Raises
    ------
    InputError, LostError
        As `map_unordered`.
    """
    for child, task in zip(children, tasks, strict=True):
        with suppress(BrokenPipeError, ConnectionResetError):
            child.pipe.send((work, task))
    found, lost = [], None
    for child in children:
        try:
            found.append(_receive(child))
        except Exception as error:
            lost = lost or error
    if lost is not None:
        raise lost
    return found


def _receive(child: Child) -> Any:
    """Next answer of a process.

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


def to_gpu_variables(device: str) -> dict[str, str]:
    """Environment in which a process sees the card of a device alone, as "cuda:0"; none of another device."""
    kind, _, number = device.partition(":")
    if kind != "cuda":
        return {}
    cards = os.environ.get(VISIBLE, "")
    return {VISIBLE: cards.split(",")[int(number or 0)] if cards else number or "0"}


def _started(device: str, make: Callable[..., Any], given: tuple[Any, ...], closing: ExitStack) -> Child:
    ours, theirs = Pipe()
    variables = to_gpu_variables(device)
    own = "cuda:0" if variables else device
    process = start_process(_serve, theirs, own, make, given, name=device, variables=variables)
    theirs.close()
    child = Child(device, process, ours)
    closing.callback(_end, child)
    return child


@contextmanager
def _environment(more: Mapping[str, str]) -> Iterator[None]:
    """Set variables for the time of the block."""
    before = {name: os.environ.get(name) for name in more}
    os.environ.update(more)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C for the time of the block: a process that is started there inherits that."""
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
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        made = _tried(make, device, *given)
        pipe.send(made if isinstance(made, Exception) else None)
        while True:
            work, task = pipe.recv()
            pipe.send(_tried(work, made, task))


def _second(device: str, given: Any) -> Any:
    return given


def _call(function: Callable[[Task], Any], task: Task) -> Any:
    return function(task)


def _tried(function: Callable[..., Any], *given: Any) -> Any:
    """What a function gives, or what it raises, with its traceback as a note."""
    try:
        return function(*given)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error


def _run(target: Callable[..., object], given: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    target(*given)


def _end_with_parent() -> None:
    """End this process when the one that started it ends."""
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

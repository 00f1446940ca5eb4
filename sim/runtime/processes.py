"""Spawned processes: a single process that runs a function, and a pool that runs tasks, one process per device."""

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
EXIT_TIMEOUT = 5.0  # Maximum time for a process to end after it has closed its pipe [s].
VISIBLE_VARIABLE = "CUDA_VISIBLE_DEVICES"
"""Name of the environment variable that lists the GPUs a process can use."""


class LostProcessError(InputError):
    """Error if a process was killed or its GPU failed; results of the other processes are kept."""


@dataclass(frozen=True, eq=False)
class ChildProcess:
    """Process that uses a device, and the pipe to this process."""

    device: str
    process: BaseProcess
    pipe: Any  # its class differs on Windows


def start_process(
    target: Callable[..., object], *args: Any, name: str, variables: Mapping[str, str] | None = None
) -> BaseProcess:
    """Return a started process that calls `target(*args)`, where `target` is a function of a module.

    The child process ends with this process, and ignores Ctrl-C, which the terminal sends to both processes. The
    `variables` are set in its environment before its first import.
    """
    process = get_context("spawn").Process(target=_run_target, args=(target, args), name=name, daemon=True)
    with _set_environment(variables or {}), _ignore_interrupts():
        process.start()
    return process


@contextmanager
def process_pool(devices: Sequence[str], build: Callable[..., Any], *args: Any) -> Iterator[tuple[ChildProcess, ...]]:
    """Yield a process for each device, which calls `build(device, *args)`; all processes are killed at the end.

    Each process can use only its own GPU, as "cuda:0". `build` is a function of a module.

    Raises
    ------
    InputError
        Raised by `build`.
    LostProcessError
        A process that was killed.
    """
    with ExitStack() as closing:
        children = [_start_child(device, build, args, closing) for device in devices]
        for child in children:
            _receive_result(child)
        yield tuple(children)


def map_parallel(function: Callable[[Task], Any], tasks: Sequence[Task], count: int = 1) -> Iterator[tuple[Task, Any]]:
    """Yield each task and its result, in order of completion, from up to `count` processes, killed at the end.

    Raises
    ------
    InputError, LostProcessError
        See `map_unordered`.
    """
    with process_pool(["cpu"] * min(count, len(tasks)), _return_value, function) as children:
        yield from map_unordered(children, _apply_function, tasks)


def map_unordered(
    children: Sequence[ChildProcess], call: Callable[[Any, Task], Any], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Any]]:
    """Yield each task with its result `work(made, task)`, in order of completion; idle processes take the next task.

    Raises
    ------
    InputError
        Raised by `call`.
    LostProcessError
        A process that was killed. Finished results of the others are yielded first.
    """
    waiting, busy = iter(tasks), {}
    lost: Exception | None = None

    def send_next(child: ChildProcess) -> None:
        for task in waiting:
            with suppress(BrokenPipeError, ConnectionResetError):  # reported when its result is read
                child.pipe.send((call, task))
            busy[child.pipe] = child, task
            return

    for child in children:
        send_next(child)
    while busy:
        ready = wait(list(busy), 0.0 if lost else None)
        if not ready:
            break
        for pipe in ready:
            child, task = busy.pop(pipe)
            try:
                answer = _receive_result(child)
            except Exception as error:
                lost = lost or error
                continue
            if lost is None:
                send_next(child)
            yield task, answer
    if lost is not None:
        raise lost


def run_on_each(children: Sequence[ChildProcess], call: Callable[[Any, Task], Any], tasks: Sequence[Task]) -> list[Any]:
    """Return the results of one task per process; all tasks start at the same time.

    Raises
    ------
    InputError, LostProcessError
        See `map_unordered`.
    """
    for child, task in zip(children, tasks, strict=True):
        with suppress(BrokenPipeError, ConnectionResetError):
            child.pipe.send((call, task))
    found, lost = [], None
    for child in children:
        try:
            found.append(_receive_result(child))
        except Exception as error:
            lost = lost or error
    if lost is not None:
        raise lost
    return found


def _receive_result(child: ChildProcess) -> Any:
    """Return the next result of a process.

    Raises
    ------
    LostProcessError
        The process was killed, or its GPU failed.
    """
    try:
        answer = child.pipe.recv()
    except (EOFError, ConnectionResetError):
        child.process.join(EXIT_TIMEOUT)
        raise LostProcessError(
            f"the process on {child.device} was ended{_format_exit_code(child.process.exitcode)}. If that happens "
            f"again, give --device one {child.device} less."
        ) from None
    if not isinstance(answer, Exception):
        return answer
    if isinstance(answer, RuntimeError) and child.device.startswith("cuda"):  # raised by Warp and torch for a GPU
        reason = (str(answer).strip() or type(answer).__name__).splitlines()[0]
        raise LostProcessError(
            f"{child.device} failed: {reason}. If that happens again, give --device one {child.device} less."
        ) from answer
    raise answer


def build_gpu_environment(device: str) -> dict[str, str]:
    """Return environment variables with which a process can use only the GPU `device`, as "cuda:0"; empty for a CPU."""
    kind, _, number = device.partition(":")
    if kind != "cuda":
        return {}
    cards = os.environ.get(VISIBLE_VARIABLE, "")
    return {VISIBLE_VARIABLE: cards.split(",")[int(number or 0)] if cards else number or "0"}


def _start_child(device: str, build: Callable[..., Any], args: tuple[Any, ...], stack: ExitStack) -> ChildProcess:
    ours, theirs = Pipe()
    variables = build_gpu_environment(device)
    own = "cuda:0" if variables else device
    process = start_process(_run_worker, theirs, own, build, args, name=device, variables=variables)
    theirs.close()
    child = ChildProcess(device, process, ours)
    stack.callback(_kill_child, child)
    return child


@contextmanager
def _set_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables during the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _ignore_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C during the block; a process that starts in the block inherits this."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _kill_child(child: ChildProcess) -> None:
    child.process.kill()
    child.process.join()
    child.pipe.close()


def _run_worker(pipe: Any, device: str, build: Callable[..., Any], args: tuple[Any, ...]) -> None:
    """Call `build`, then run tasks from the pipe until it closes; exceptions are sent as results."""
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        made = _try_call(build, device, *args)
        pipe.send(made if isinstance(made, Exception) else None)
        while True:
            work, task = pipe.recv()
            pipe.send(_try_call(work, made, task))


def _return_value(device: str, value: Any) -> Any:
    return value


def _apply_function(function: Callable[[Task], Any], task: Task) -> Any:
    return function(task)


def _try_call(function: Callable[..., Any], *args: Any) -> Any:
    """Return the result of a function or, if the function raises an exception, this exception with a traceback note."""
    try:
        return function(*args)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error


def _run_target(target: Callable[..., object], args: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    target(*args)


def _end_with_parent() -> None:
    """End this process when its parent process ends."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _format_exit_code(exit_code: int | None) -> str:
    """Return a note in brackets on the exit code of a process."""
    if exit_code is None or exit_code == 0:
        return ""
    if exit_code > 0:
        return f" (exit code {exit_code})"
    name = signal.strsignal(-exit_code) or f"signal {-exit_code}"
    return f" ({name}), probably out of memory" if -exit_code == signal.SIGKILL else f" ({name})"

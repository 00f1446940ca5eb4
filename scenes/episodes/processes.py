"""Dask workers as processes of this machine, which are started again whenever they end.

Dask's own nanny gives up on a worker that is killed while it starts.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.process import BaseProcess
from typing import Any

from dask import config
from distributed import Security, Worker

from sim.errors import InputError
from sim.runtime.processes import card_variables, start_process

HERE = "127.0.0.1"
"""Where a scheduler and workers of our own listen: nobody outside this machine reaches them."""
CARD = "GPU"
"""What a worker with a card of its own offers, by Dask's custom."""
ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""One thread a process: as many processes as cores, and the same sums whoever adds them."""


@dataclass(frozen=True, eq=False)
class _Started:
    process: BaseProcess
    said: Any  # a pipe, whose class is another on Windows: something comes once it is connected
    times: int


@contextmanager
def started_processes(
    address: str, security: Security, devices: Sequence[str], starts: int
) -> Iterator[Callable[[], None]]:
    """Workers of the scheduler at an address, one for each device, killed at the end; gives what tends them.

    Whoever calls that now and then has those started again that ended.

    Raises
    ------
    InputError
        When they are tended: one that has ended `starts` times in a row without having been connected.
    """
    crew = [_start(address, security, device, 1) for device in devices]

    def tend() -> None:
        for place, one in enumerate(crew):
            if one.process.is_alive():
                continue
            times = 1 if _has_served(one) else one.times + 1
            if times > starts:
                raise InputError(
                    f"a process on {devices[place]} has ended {starts} times as it started "
                    f"(exit code {one.process.exitcode}). Give fewer --workers, or look for want of memory."
                )
            _close(one)
            crew[place] = _start(address, security, devices[place], times)

    try:
        yield tend
    finally:  # nobody waits for what they compute just then
        for one in crew:
            one.process.kill()
        for one in crew:
            one.process.join()
            _close(one)


def quiet_dask() -> None:
    """Let Dask print no notes of its own: what matters of them is said in our sentences."""
    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _start(address: str, security: Security, device: str, times: int) -> _Started:
    ours, theirs = Pipe(duplex=False)
    card = card_variables(device)
    resources = {CARD: 1.0} if card else None
    process = start_process(_serve, address, security, resources, theirs, name="worker", variables={**ALONE, **card})
    theirs.close()
    return _Started(process, ours, times)


def _has_served(one: _Started) -> bool:
    try:
        return one.said.poll() and one.said.recv_bytes() is not None
    except (EOFError, OSError):
        return False


def _close(one: _Started) -> None:
    one.process.close()
    one.said.close()


def _serve(address: str, security: Security, resources: dict[str, float] | None, connected: Any) -> None:
    quiet_dask()
    # A profile holds on to what a task has closed, and what is served by HTTP asks for no keys.
    with config.set({"distributed.worker.profile.enabled": False, "distributed.worker.http.routes": []}):
        asyncio.run(_work(address, security, resources, connected))


async def _work(address: str, security: Security, resources: dict[str, float] | None, connected: Any) -> None:
    # Without a limit: a worker that is paused near its share of memory never goes on, as its memory is not Dask's.
    settings = {"nthreads": 1, "host": HERE, "memory_limit": 0, "resources": resources, "dashboard": False}
    async with Worker(address, security=security, **settings) as worker:
        connected.send_bytes(b"yes")
        await worker.finished()

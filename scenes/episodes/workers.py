"""Workers that make episodes: processes of this machine, or workers of a running Dask scheduler.

Processes are started here because Dask's nanny does not restart a worker that is killed during its start.
"""

import asyncio
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.process import BaseProcess
from typing import Any

import cryptography  # noqa: F401  `Security.temporary` needs it
from dask import config
from distributed import Client, Scheduler, Security, SpecCluster, Worker

from sim.errors import InputError
from sim.runtime.processes import build_gpu_environment, start_process

LOCAL_HOST = "127.0.0.1"
"""Address of local scheduler and workers, which is not reachable from other machines."""
GPU_RESOURCE = "GPU"
"""Name of the resource of a worker with its own GPU, by Dask's convention."""
ONE_THREAD_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment variables that limit a process to one thread, because there are as many processes as cores."""
MAX_WORKER_DEATHS = 20
"""Number of lost workers after which a task fails; it is large because machines may be withdrawn at any time."""
SETTINGS = {  # Settings of Dask.
    "distributed.scheduler.allowed-failures": MAX_WORKER_DEATHS,
    "distributed.scheduler.worker-ttl": None,  # clocks jump, as after sleep; ended processes are detected
    "distributed.scheduler.http.routes": [],  # HTTP services need no keys
}
SCHEDULER_TIMEOUT = 10.0
"""Time-out of the connection to a scheduler [s]."""


@dataclass(frozen=True, eq=False)
class _WorkerProcess:
    process: BaseProcess
    connection: Any  # pipe, of another class on Windows: a message once it is connected
    start_count: int


@contextmanager
def start_processes(
    address: str, security: Security, devices: Sequence[str], max_starts: int
) -> Iterator[Callable[[], None]]:
    """Start a worker of the scheduler at `address` for each device; yield a function that restarts ended workers.

    The function must be called regularly. The workers are killed at the end of the block.

    Raises
    ------
    InputError
        From the yielded function, if a process ended `max_starts` times in a row before it was connected.
    """
    crew = [_start_worker(address, security, device, 1) for device in devices]

    def restart_ended() -> None:
        for place, one in enumerate(crew):
            if one.process.is_alive():
                continue
            times = 1 if _has_served(one) else one.start_count + 1
            if times > max_starts:
                raise InputError(
                    f"a process on {devices[place]} crashed {max_starts} times at start-up "
                    f"(exit code {one.process.exitcode}). Use fewer --workers, or check the free memory."
                )
            _close_worker(one)
            crew[place] = _start_worker(address, security, devices[place], times)

    try:
        yield restart_ended
    finally:  # their current results are not needed
        for one in crew:
            one.process.kill()
        for one in crew:
            one.process.join()
            _close_worker(one)


def silence_dask() -> None:
    """Suppress log messages of Dask, because relevant events are reported in messages of sulcus."""
    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _start_worker(address: str, security: Security, device: str, start_count: int) -> _WorkerProcess:
    ours, theirs = Pipe(duplex=False)
    card = build_gpu_environment(device)
    resources = {GPU_RESOURCE: 1.0} if card else None
    process = start_process(
        _run_worker, address, security, resources, theirs, name="worker", variables={**ONE_THREAD_VARIABLES, **card}
    )
    theirs.close()
    return _WorkerProcess(process, ours, start_count)


def _has_served(worker: _WorkerProcess) -> bool:
    try:
        return worker.connection.poll() and worker.connection.recv_bytes() is not None
    except (EOFError, OSError):
        return False


def _close_worker(worker: _WorkerProcess) -> None:
    worker.process.close()
    worker.connection.close()


def _run_worker(address: str, security: Security, resources: dict[str, float] | None, ready_pipe: Any) -> None:
    silence_dask()
    # Profiles keep references to closed files, and HTTP services need no keys.
    with config.set({"distributed.worker.profile.enabled": False, "distributed.worker.http.routes": []}):
        asyncio.run(_serve_tasks(address, security, resources, ready_pipe))


async def _serve_tasks(address: str, security: Security, resources: dict[str, float] | None, ready_pipe: Any) -> None:
    # No memory limit: a worker paused near its limit never resumes, because Dask does not manage its memory.
    settings = {"nthreads": 1, "host": LOCAL_HOST, "memory_limit": 0, "resources": resources, "dashboard": False}
    async with Worker(address, security=security, **settings) as worker:
        ready_pipe.send_bytes(b"yes")
        await worker.finished()


@dataclass(frozen=True, eq=False)
class Workers:
    """Workers that make episodes, with the connection to their scheduler.

    Parameters
    ----------
    client
        Connection to the scheduler.
    device
        "cpu" or "cuda".
    description
        Description of the workers for messages.
    restart
        Function that restarts ended processes.
    """

    client: Client
    device: str
    description: str
    restart: Callable[[], None] = lambda: None

    @property
    def needs(self) -> dict[str, int] | None:
        """Dask resources that a task requires of a worker; None on the CPU."""
        return {GPU_RESOURCE: 1} if self.device == "cuda" else None

    def count(self) -> int:
        """Return the current number of workers.

        Raises
        ------
        InputError
            The scheduler ended, or a process ends repeatedly right after its start.
        """
        self.restart()
        if self.client.status != "running":
            raise describe_scheduler_end(self.description)
        try:
            known = self.client.scheduler_info(n_workers=-1)["workers"].values()
        except (OSError, TimeoutError) as error:
            raise describe_scheduler_end(self.description) from error
        return sum(self.needs is None or GPU_RESOURCE in one["resources"] for one in known)


@contextmanager
def start_local_workers(
    devices: Sequence[str], settings: Mapping[str, object] | None = None, max_starts: int = 10
) -> Iterator[Workers]:
    """Yield workers in processes of this machine, one for each name in `devices`; a process uses only its own GPU.

    Processes are spawned, restarted if they end, and killed at the end of the block or of this process. Since a
    scheduler and its workers execute code of any client, TLS keys, which exist only in the memory of these processes,
    exclude other users of the machine.

    Parameters
    ----------
    devices
        Names of devices of one kind, such as "cpu" or "cuda:1".
    settings
        Dask settings in addition to `SETTINGS`.
    max_starts
        Maximum number of consecutive crashes of a process before its first task is done.
    """
    device = devices[0].split(":")[0]
    with _restore_environment(), config.set({**SETTINGS, **(settings or {})}):
        silence_dask()
        security = Security.temporary()
        options = {"host": LOCAL_HOST, "port": 0, "protocol": "tls://", "security": security}
        options |= {"dashboard": False, "dashboard_address": f"{LOCAL_HOST}:0"}
        scheduler = {"cls": Scheduler, "options": options}
        with (
            closing(SpecCluster({}, scheduler, security=security, name=f"sulcus-{os.getpid()}")) as cluster,
            Client(cluster, set_as_default=False) as client,
            start_processes(cluster.scheduler_address, security, devices, max_starts) as tend,
        ):
            yield Workers(client, device, f"{len(devices)} process{'es' * (len(devices) > 1)} on {device}", tend)


@contextmanager
def connect_workers(address: str, device: str, timeout: float = SCHEDULER_TIMEOUT) -> Iterator[Workers]:
    """Yield the workers of a running Dask scheduler; the number of workers may change.

    Parameters
    ----------
    device
        "cpu", "cuda", or "auto" ("cuda" if any worker has a GPU).
    timeout
        Time-out of the scheduler [s].

    Raises
    ------
    InputError
        The scheduler cannot be reached.
    """
    silence_dask()
    try:
        client = Client(address, set_as_default=False, timeout=timeout)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler at this address. Start one by `dask scheduler`, and use the "
            "address that it prints."
        ) from error
    with client:
        if device == "auto":
            cards = Workers(client, "cuda", address).count()
            device = "cuda" if cards else "cpu"
        yield Workers(client, device, f"the workers of {address} on {device}")


@contextmanager
def _restore_environment() -> Iterator[None]:
    """Restore all environment variables at the end of the block, because Dask changes some variables."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def describe_scheduler_end(workers: str) -> InputError:
    """Build the error for a scheduler that ended; `workers` describes its workers."""
    return InputError(f"{workers}: their scheduler ended. Results are kept; run the same command again to resume.")

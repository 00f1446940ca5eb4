"""Workers that make episodes: processes of this machine, or those of a running scheduler.

Dask's own nanny gives up on a worker that is killed while it starts.
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
from sim.runtime.processes import start_process, to_gpu_variables

LOCAL_HOST = "127.0.0.1"
"""Address of the scheduler and workers: not reachable from outside this machine."""
GPU_RESOURCE = "GPU"
"""Resource of a worker with its own GPU, by Dask's convention."""
ONE_THREAD_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""One thread per process: as many processes as cores, and reproducible sums."""
MAX_WORKER_DEATHS = 20
"""Number of lost workers after which a task is given up: machines may be taken back at any time."""
SETTINGS = {  # Settings of Dask.
    "distributed.scheduler.allowed-failures": MAX_WORKER_DEATHS,
    "distributed.scheduler.worker-ttl": None,  # clocks jump, as after sleep; ended processes are detected
    "distributed.scheduler.http.routes": [],  # HTTP services need no keys
}
SCHEDULER_TIMEOUT = 10.0
"""Time-out of a scheduler [s]."""


@dataclass(frozen=True, eq=False)
class _Started:
    process: BaseProcess
    said: Any  # pipe, of another class on Windows: a message once it is connected
    times: int


@contextmanager
def start_processes(
    address: str, security: Security, devices: Sequence[str], starts: int
) -> Iterator[Callable[[], None]]:
    """Start workers of the scheduler at an address, one for each device, killed at the end; yield a restart function.

    Call it regularly: it restarts workers that ended.

    Raises
    ------
    InputError
        In the restart function: a process ended `starts` times in a row without a connection.
    """
    crew = [_start(address, security, device, 1) for device in devices]

    def tend() -> None:
        for place, one in enumerate(crew):
            if one.process.is_alive():
                continue
            times = 1 if _has_served(one) else one.times + 1
            if times > starts:
                raise InputError(
                    f"a process on {devices[place]} crashed {starts} times at start-up "
                    f"(exit code {one.process.exitcode}). Use fewer --workers, or check the free memory."
                )
            _close(one)
            crew[place] = _start(address, security, devices[place], times)

    try:
        yield tend
    finally:  # their current results are not needed
        for one in crew:
            one.process.kill()
        for one in crew:
            one.process.join()
            _close(one)


def silence_dask() -> None:
    """Silence Dask's own notes: relevant ones are reported in our messages."""
    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _start(address: str, security: Security, device: str, times: int) -> _Started:
    ours, theirs = Pipe(duplex=False)
    card = to_gpu_variables(device)
    resources = {GPU_RESOURCE: 1.0} if card else None
    process = start_process(
        _serve, address, security, resources, theirs, name="worker", variables={**ONE_THREAD_VARIABLES, **card}
    )
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
    silence_dask()
    # Profiles keep references to closed files, and HTTP services need no keys.
    with config.set({"distributed.worker.profile.enabled": False, "distributed.worker.http.routes": []}):
        asyncio.run(_work(address, security, resources, connected))


async def _work(address: str, security: Security, resources: dict[str, float] | None, connected: Any) -> None:
    # No memory limit: a worker paused near its limit never resumes, because Dask does not manage its memory.
    settings = {"nthreads": 1, "host": LOCAL_HOST, "memory_limit": 0, "resources": resources, "dashboard": False}
    async with Worker(address, security=security, **settings) as worker:
        connected.send_bytes(b"yes")
        await worker.finished()


@dataclass(frozen=True, eq=False)
class Workers:
    """Processes that make episodes.

    Parameters
    ----------
    client
        Connection to the scheduler.
    device
        "cpu" or "cuda".
    where
        Description of the machines.
    tend
        Function that restarts ended processes.
    """

    client: Client
    device: str
    where: str
    tend: Callable[[], None] = lambda: None

    @property
    def needs(self) -> dict[str, int] | None:
        """Resources that a task requires of a worker."""
        return {GPU_RESOURCE: 1} if self.device == "cuda" else None

    def count(self) -> int:
        """Return the current number of workers.

        Raises
        ------
        InputError
            A scheduler that ended; processes that end as soon as they are started.
        """
        self.tend()
        if self.client.status != "running":
            raise describe_scheduler_end(self.where)
        try:
            known = self.client.scheduler_info(n_workers=-1)["workers"].values()
        except (OSError, TimeoutError) as error:
            raise describe_scheduler_end(self.where) from error
        return sum(self.needs is None or GPU_RESOURCE in one["resources"] for one in known)


@contextmanager
def start_own_workers(
    devices: Sequence[str], settings: Mapping[str, object] | None = None, starts: int = 10
) -> Iterator[Workers]:
    """Yield processes of this machine, one for each name in `devices`, each with the GPU in its name.

    They are spawned, restarted if they end, and killed when the block or this process ends. A scheduler and its
    workers execute the code of any client: TLS keys that exist only in the memory of these processes exclude other
    users of the machine.

    Parameters
    ----------
    devices
        Devices, such as "cpu" or "cuda:1"; all of one kind.
    settings
        Settings of Dask, in addition to `SETTINGS`.
    starts
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
            start_processes(cluster.scheduler_address, security, devices, starts) as tend,
        ):
            yield Workers(client, device, f"{len(devices)} process{'es' * (len(devices) > 1)} on {device}", tend)


@contextmanager
def connect_workers(address: str, device: str, patience: float = SCHEDULER_TIMEOUT) -> Iterator[Workers]:
    """Yield the workers of a running scheduler; their number may change.

    Parameters
    ----------
    device
        "cpu", "cuda", or "auto": cuda if one of the workers has a GPU.
    patience
        Time-out of the scheduler [s].

    Raises
    ------
    InputError
        A scheduler that cannot be reached.
    """
    silence_dask()
    try:
        client = Client(address, set_as_default=False, timeout=patience)
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
    """Restore the environment variables that Dask sets, at the end of the block."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def describe_scheduler_end(where: str) -> InputError:
    """Return the error of a lost scheduler."""
    return InputError(f"{where}: their scheduler ended. Results are kept; run the same command again to resume.")

"""Who makes the episodes: processes of this machine, or those that a running scheduler has."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from dask import config
from distributed import Client, Nanny, Scheduler, SpecCluster

from sim.errors import InputError
from sim.runtime.processes import VISIBLE

HERE = "127.0.0.1"
"""Where a scheduler of our own listens: nobody outside this machine reaches it."""
MOST_DEATHS = 20
"""How often a task may see its worker end before it is given up: machines are taken back at any time."""
SETTINGS = {
    "distributed.scheduler.allowed-failures": MOST_DEATHS,
    "distributed.scheduler.worker-ttl": "30 minutes",  # a long call in C answers nobody meanwhile
    "distributed.worker.multiprocessing-method": "spawn",
}
ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""One thread a process: as many processes as cores, and the same sums whoever adds them."""
QUIET = {"DASK_LOGGING__DISTRIBUTED": "CRITICAL", "DASK_LOGGING__TORNADO": "CRITICAL"}
PATIENCE = 10.0
"""How long a scheduler may take to answer [s]."""
CARD = "GPU"
"""What a worker with a card of its own offers, by Dask's custom."""


@dataclass(frozen=True, eq=False)
class Workers:
    """Processes that make episodes.

    Parameters
    ----------
    client
        To their scheduler.
    device
        "cpu" or "cuda".
    where
        They are, in words.
    """

    client: Client
    device: str
    where: str

    @property
    def needs(self) -> Mapping[str, int] | None:
        """What a task asks of a worker."""
        return {CARD: 1} if self.device == "cuda" else None

    def count(self) -> int:
        """How many there are now.

        Raises
        ------
        InputError
            A scheduler that ended.
        """
        if self.client.status != "running":
            raise scheduler_ended(self.where)
        try:
            known = self.client.scheduler_info(n_workers=-1)["workers"].values()
        except (OSError, TimeoutError) as error:
            raise scheduler_ended(self.where) from error
        return sum(self.needs is None or CARD in one["resources"] for one in known)


@contextmanager
def own_workers(devices: Sequence[str], settings: Mapping[str, object] | None = None) -> Iterator[Workers]:
    """Processes of this machine, one for each name in `devices`, each with the card that its name has.

    They are spawned, restarted when they end, and killed when the block ends or this process does.

    Parameters
    ----------
    devices
        As "cpu" or "cuda:1"; all of one kind.
    """
    device = devices[0].split(":")[0]
    with _environment(QUIET), config.set({**SETTINGS, **(settings or {})}):
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        scheduler = {"cls": Scheduler, "options": {"host": HERE, "port": 0, "dashboard_address": f"{HERE}:0"}}
        processes = {number: {"cls": Nanny, "options": _given(name)} for number, name in enumerate(devices)}
        with (
            SpecCluster(processes, scheduler, silence_logs=logging.CRITICAL, name=f"sulcus-{os.getpid()}") as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            try:
                yield Workers(client, device, f"{len(devices)} process{'es' * (len(devices) > 1)} on {device}")
            except BaseException:  # nobody waits for what they compute just then
                _kill(cluster)
                raise


def _kill(cluster: SpecCluster) -> None:
    for nanny in cluster.workers.values():
        if isinstance(nanny, Nanny) and nanny.process is not None and nanny.process.pid is not None:
            os.kill(nanny.process.pid, signal.SIGKILL)


@contextmanager
def scheduled_workers(address: str, device: str, patience: float = PATIENCE) -> Iterator[Workers]:
    """The workers of a running scheduler, who may come and go.

    Parameters
    ----------
    device
        "cpu", "cuda", or "auto": cuda if one of them offers a card just now.
    patience
        How long the scheduler may take to answer [s].

    Raises
    ------
    InputError
        A scheduler that does not answer.
    """
    try:
        client = Client(address, set_as_default=False, timeout=patience)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there. Start one by `dask scheduler`, and give the "
            "address that it prints."
        ) from error
    with client:
        if device == "auto":
            cards = Workers(client, "cuda", address).count()
            device = "cuda" if cards else "cpu"
        yield Workers(client, device, f"the workers of {address} on {device}")


def _given(device: str) -> dict[str, object]:
    kind, _, card = device.partition(":")
    shown = os.environ.get(VISIBLE, "")
    card = shown.split(",")[int(card or 0)] if shown else card or "0"
    on_card = kind == "cuda"
    return {
        "nthreads": 1,
        "host": HERE,
        "memory_limit": 0,  # a worker that is paused near its share never goes on: its memory is not Dask's
        "resources": {CARD: 1} if on_card else {},
        "env": {**ALONE, **({VISIBLE: card} if on_card else {})},
        "silence_logs": logging.CRITICAL,
    }


@contextmanager
def _environment(more: Mapping[str, str]) -> Iterator[None]:
    """Variables for the processes to come; Dask sets some more, which end with the block, too."""
    before = dict(os.environ)
    os.environ.update(more)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def scheduler_ended(where: str) -> InputError:
    """What is said when a scheduler is gone."""
    return InputError(f"{where} answer no more: their scheduler ended. What is finished stays; the same command goes on.")

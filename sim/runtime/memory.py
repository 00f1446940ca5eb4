"""Whether a batch fits into memory: said before it is solved, with the batch that would."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ..errors import InputError
from .columns import find_widest_workspace, find_workspace_width
from .device import Device

# Columns of the solver at its widest: pairs of L-BFGS, those that move elsewhere, vectors of the elimination around it.
# Arrays counted on the CPU, 2026-11-24: at most 46 where levels precondition (19,508 and 26,452 nodes, smoothed).
WORK_COLUMNS = 60
# Copies of the answer on the host while batches are joined, in double precision.
ANSWER_COPIES = 3
COARSER = "take a coarser mesh, or a larger machine."


@dataclass(frozen=True)
class MemoryBudget:
    """What of a machine's memory a solver may use.

    Parameters
    ----------
    share
        Of what is free: other programs live too.
    batches
        Share of what is free that a batch of unnamed width may take: half, so that answers and others have room.
    widest, widest_on_cuda
        Load cases that are worth solving together: more fill the processor no better.
    group
        Folder in which Linux tells what a group of processes, a container say, may have and has.
    """

    share: float = 0.9
    batches: float = 0.5
    widest: int = 64
    widest_on_cuda: int = 16384
    group: Path = Path("/sys/fs/cgroup")


def measure_free_bytes(device: Device, budget: MemoryBudget = MemoryBudget()) -> int:
    """Memory that is free: the card's, or what the host and its control group still give."""
    if device.on_cuda:
        return int(wp.get_device(device.name).free_memory)
    return measure_host_bytes(budget)


def measure_host_bytes(budget: MemoryBudget = MemoryBudget()) -> int:
    """Memory that the host and its control group still give; without bound where neither says."""
    found = [2**62]
    for line in _lines(Path("/proc/meminfo")):
        if line.startswith("MemAvailable:"):
            found.append(1024 * int(line.split()[1]))
    most, used, parts = (_lines(budget.group / name) for name in ("memory.max", "memory.current", "memory.stat"))
    if most and used and most[0].strip().isdigit():
        # Cached files count as used, and are given up when memory is asked for.
        cached = sum(int(line.split()[1]) for line in parts if line.startswith("inactive_file "))
        found.append(int(most[0]) - int(used[0]) + cached)
    return min(found)


def choose_batch_size(rows: int, device: Device, free: int, budget: MemoryBudget = MemoryBudget()) -> int:
    """How many load cases of `rows` = 3N unknowns to solve together: as many as are worth it and `free` bytes hold."""
    widest = budget.widest_on_cuda if device.on_cuda else budget.widest
    fitting = int(budget.batches * free / max(estimate_column_bytes(rows, device), 1))
    return int(np.clip(find_widest_workspace(device, fitting), 1, widest))


def check_fits(
    rows: int, batch: int, count: int, device: Device, held: int = 0, budget: MemoryBudget = MemoryBudget()
) -> None:
    """Refuse `count` load cases of `rows` = 3N unknowns, `batch` together, that would not fit.

    `held` bytes are the solver's own already.

    Raises
    ------
    InputError
        Naming what it takes, what is free, and what would fit. Its cause is a MemoryError: others may leave.
    """
    column = estimate_column_bytes(rows, device)
    free = measure_host_bytes(budget)  # read once: Linux counts for a good part of a millisecond
    each, host = ANSWER_COPIES * 8 * rows, budget.share * free
    answers, alone = each * count, 0 if device.on_cuda else column
    if answers + alone > host:
        fitting = int((host - alone) / each)
        raise InputError(
            f"the answers to {count} loads take about {format_gigabytes(answers)}, "
            f"and {format_gigabytes(host)} are free: "
            + (f"solve at most {fitting} at a time." if fitting > 0 else COARSER)
        ) from MemoryError()
    available = measure_free_bytes(device) if device.on_cuda else free
    room = budget.share * available + held - (0 if device.on_cuda else answers)
    columns = min(batch, count)
    taken = column * find_workspace_width(device, columns)
    if taken > room:
        fitting = find_widest_workspace(device, int(room / column))
        remedy = f"a --batch of {fitting} fits." if fitting > 0 else COARSER
        raise InputError(
            f"a batch of {columns} loads takes about {format_gigabytes(taken)}, and {format_gigabytes(max(room, 0.0))} "
            f"are free: {remedy}"
        ) from MemoryError()


def estimate_column_bytes(rows: int, device: Device) -> int:
    """Bytes that one load case takes while it is solved."""
    return WORK_COLUMNS * wp.types.type_size_in_bytes(device.scalar) * rows


def format_gigabytes(amount: float) -> str:
    """Bytes as a person reads them."""
    return f"{amount / 2**30:.3g} GiB"


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []

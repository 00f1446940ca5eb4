"""Memory estimates for a batch, and a check before its solution that reports the size of a batch that fits."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ..errors import InputError
from .columns import find_widest_workspace, find_workspace_width
from .device import Device

# Solver arrays at the peak [columns of 3N]: L-BFGS pairs, columns being moved, vectors of the elimination around it.
# Arrays counted on the CPU, 2026-11-24: at most 46 with multigrid (19,508 and 26,452 nodes, smoothed).
WORK_COLUMNS = 60
RESULT_COPIES = 3  # Copies of the result on the host while batches are joined, in double precision.
MESH_REMEDY = "take a coarser mesh, or a larger machine."  # Remedy if not even one load fits.


@dataclass(frozen=True)
class MemoryBudget:
    """Limits of the memory of a machine that a solver may use.

    Parameters
    ----------
    fraction
        Fraction of the free memory that may be used; the remainder is for other programs.
    batch_fraction
        Fraction of the free memory for a batch of automatic size; the remainder is for results and other programs.
    max_cases, max_cases_on_cuda
        Maximum number of load cases solved together; more cases do not use the processor better.
    cgroup
        Linux folder with the memory limit and the memory use of a control group, such as a container.
    """

    fraction: float = 0.9
    batch_fraction: float = 0.5
    max_cases: int = 64
    max_cases_on_cuda: int = 16384
    cgroup: Path = Path("/sys/fs/cgroup")


def measure_free_bytes(device: Device, budget: MemoryBudget = MemoryBudget()) -> int:
    """Return the free memory [bytes] of the GPU, or of the host and its control group."""
    if device.on_cuda:
        return int(wp.get_device(device.name).free_memory)
    return measure_host_bytes(budget)


def measure_host_bytes(budget: MemoryBudget = MemoryBudget()) -> int:
    """Return the free memory of the host and its control group [bytes]; unlimited if both do not report it."""
    found = [2**62]
    for line in _read_lines(Path("/proc/meminfo")):
        if line.startswith("MemAvailable:"):
            found.append(1024 * int(line.split()[1]))
    most, used, parts = (_read_lines(budget.cgroup / name) for name in ("memory.max", "memory.current", "memory.stat"))
    if most and used and most[0].strip().isdigit():
        # Cached files count as used, but are released on demand.
        cached = sum(int(line.split()[1]) for line in parts if line.startswith("inactive_file "))
        found.append(int(most[0]) - int(used[0]) + cached)
    return min(found)


def choose_batch_size(rows: int, device: Device, free_bytes: int, budget: MemoryBudget = MemoryBudget()) -> int:
    """Return the number of load cases of `rows` = 3N unknowns that are solved together within `free_bytes` bytes."""
    widest = budget.max_cases_on_cuda if device.on_cuda else budget.max_cases
    fitting = int(budget.batch_fraction * free_bytes / max(estimate_column_bytes(rows, device), 1))
    return int(np.clip(find_widest_workspace(device, fitting), 1, widest))


def check_fits(
    rows: int, batch: int, count: int, device: Device, used_bytes: int = 0, budget: MemoryBudget = MemoryBudget()
) -> None:
    """Reject `count` load cases of `rows` = 3N unknowns, solved in batches of `batch`, if they do not fit.

    The solver already uses `used_bytes` bytes.

    Raises
    ------
    InputError
        The memory does not suffice; the message gives demand, free memory and a fitting size. Its cause: MemoryError.
    """
    column = estimate_column_bytes(rows, device)
    free = measure_host_bytes(budget)  # read once: Linux takes almost a millisecond to count
    each, host = RESULT_COPIES * 8 * rows, budget.fraction * free
    answers, alone = each * count, 0 if device.on_cuda else column
    if answers + alone > host:
        fitting = int((host - alone) / each)
        raise InputError(
            f"the results of {count} loads take about {format_gigabytes(answers)}, "
            f"and {format_gigabytes(host)} are free: "
            + (f"solve at most {fitting} at a time." if fitting > 0 else MESH_REMEDY)
        ) from MemoryError()
    available = measure_free_bytes(device) if device.on_cuda else free
    room = budget.fraction * available + used_bytes - (0 if device.on_cuda else answers)
    columns = min(batch, count)
    taken = column * find_workspace_width(device, columns)
    if taken > room:
        fitting = find_widest_workspace(device, int(room / column))
        remedy = f"a --batch of {fitting} fits." if fitting > 0 else MESH_REMEDY
        raise InputError(
            f"a batch of {columns} loads takes about {format_gigabytes(taken)}, and {format_gigabytes(max(room, 0.0))} "
            f"are free: {remedy}"
        ) from MemoryError()


def estimate_column_bytes(rows: int, device: Device) -> int:
    """Return the estimated memory of one load case during its solution [bytes]."""
    return WORK_COLUMNS * wp.types.type_size_in_bytes(device.scalar) * rows


def format_gigabytes(size: float) -> str:
    """Return a text with an amount of memory in GiB."""
    return f"{size / 2**30:.3g} GiB"


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []

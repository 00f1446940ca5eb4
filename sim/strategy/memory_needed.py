"""Estimate of the GPU memory that `Fem` needs, from the mesh, before any allocation."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ..accuracy import Accuracy
from ..anatomy import Anatomy
from ..discretisation.space import Discretisation, discretise
from ..errors import InputError
from ..linalg.preconditioner import Preconditioning
from ..runtime.columns import find_widest_workspace, find_workspace_width
from ..runtime.device import Device, find_device
from ..runtime.memory import (
    MESH_REMEDY,
    MemoryBudget,
    choose_batch_size,
    estimate_column_bytes,
    format_gigabytes,
    measure_free_bytes,
)

BYTES_PER_NODE = {"p1": 2_200, "smoothed": 5_800, "p2": 2_900, "element-free": 9_000}
"""Memory per node in single precision [bytes]: element tables and multigrid levels. The arrays were counted on the
CPU, for 49,239 nodes (p1, smoothed) and 123,508 nodes (p2), 2026-11-24. Element-free: sizes of the tables and of
the stiffness for 5,312 nodes."""
FIXED_BYTES = 2**30
"""Approximate memory of library buffers, kernels and the coarsest multigrid level [bytes]."""
BUDGET = MemoryBudget()
"""Default limits for the use of GPU memory."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Estimate of the device memory for a number of loads [bytes].

    Parameters
    ----------
    nodes, element
        Number of mesh nodes, and element type.
    device
        Device of the FEM.
    setup_bytes, constant_bytes, bytes_per_load
        Peak memory during set-up; constant memory afterwards; additional memory per load of a batch.
    batch
        Number of loads solved together.
    free_bytes
        Free memory of the device that one process may use.
    """

    nodes: int
    element: str
    device: Device
    setup_bytes: int
    constant_bytes: int
    bytes_per_load: int
    batch: int
    free_bytes: int

    @property
    def peak_bytes(self) -> int:
        """Peak memory [bytes]; this includes that the workspace of a batch may be wider than the batch."""
        workspace_bytes = find_workspace_width(self.device, self.batch) * self.bytes_per_load
        return max(self.setup_bytes, self.constant_bytes + workspace_bytes)

    def __str__(self) -> str:
        loads = f"{self.batch} loads together" if self.batch > 1 else "one load at a time"
        taken, free = format_gigabytes(self.peak_bytes), format_gigabytes(self.free_bytes)
        return f"{self.nodes:,} nodes ({self.element}), {loads}: about {taken} of {self.device.name}, {free} free"

    def check_fits(self, budget: MemoryBudget = BUDGET) -> MemoryEstimate:
        """Return this object if its peak fits in the free memory.

        Raises
        ------
        InputError
            There is too little free memory; the message gives the demand, the free memory, and a size that fits.
        """
        room = budget.fraction * self.free_bytes
        if self.peak_bytes <= room:
            return self
        fitting = find_widest_workspace(self.device, int((room - self.constant_bytes) / self.bytes_per_load))
        fits = self.setup_bytes <= room and fitting > 0
        raise InputError(f"{self}: {f'a --batch of {fitting} fits.' if fits else MESH_REMEDY}")


def estimate_fem_memory(
    anatomy: Anatomy,
    element: str | None,
    accuracy: Accuracy,
    device: str,
    batch: int | None,
    load_count: int,
    process_count: int = 1,
) -> MemoryEstimate | None:
    """Return the estimated GPU memory of `Fem` for a number of loads; None on the CPU, where each batch is checked.

    If `batch` is None, the largest batch that fits is assumed. `process_count` processes share the GPU equally.

    Raises
    ------
    InputError
        The element is unknown, or the device is not available.
    """
    where = find_device(device, accuracy.precision)
    if not where.on_cuda:
        return None
    space = discretise(anatomy.mesh, element)
    free = measure_free_bytes(where) // process_count
    inverted = _find_invertible_unknowns(_list_unknowns(space, anatomy), where)
    return compute_memory(space, where, inverted, batch, load_count, free)


def compute_memory(
    space: Discretisation,
    device: Device,
    inverted_rows: int,
    batch: int | None,
    load_count: int,
    free_bytes: int,
    budget: MemoryBudget = BUDGET,
) -> MemoryEstimate:
    """Return the memory if the preconditioner inverts `inverted_rows` unknowns, and `free_bytes` of memory are free."""
    rows, width = 3 * space.count, wp.types.type_size_in_bytes(device.scalar)
    tables = FIXED_BYTES + BYTES_PER_NODE[space.element] * space.count * width // 4
    taken, left = _estimate_inverse_bytes(inverted_rows, device)
    column = estimate_column_bytes(rows, device)
    if batch is None:
        batch = choose_batch_size(rows, device, free_bytes - tables - left, budget)
    nodes, setup, constant = len(space.mesh.nodes), tables + taken, tables + left
    return MemoryEstimate(nodes, space.element, device, setup, constant, column, min(batch, load_count), free_bytes)


def _list_unknowns(space: Discretisation, anatomy: Anatomy) -> tuple[int, ...]:
    """Return the numbers of unknowns that a preconditioner may invert: those of all nodes, then of the corners."""
    corners = int((~anatomy.fixed).sum())
    return (int((~space.extend_fixed(anatomy.fixed)).sum()), corners) if space.element == "p2" else (corners,)


def _find_invertible_unknowns(unknowns: tuple[int, ...], device: Device) -> int:
    """Return the first number in `unknowns` whose inverse fits the GPU, else that of the coarsest multigrid level."""
    from ..linalg.dense_inverse import can_invert

    last = 6 * Preconditioning().max_coarsest_nodes
    return next((count for count in unknowns if can_invert(count, device)), last)


def _estimate_inverse_bytes(unknowns: int, device: Device) -> tuple[int, int]:
    """Return the estimated memory of a dense inverse [bytes]: peak during construction, and afterwards."""
    from ..linalg.block_inverse import estimate_bytes
    from ..linalg.dense_inverse import estimate_inverse_bytes

    left = estimate_inverse_bytes(unknowns, device)
    return estimate_bytes(unknowns) + left, left

"""What finite elements will take of a card's memory, foreseen from their mesh before anything is made."""

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
    COARSER,
    MemoryBudget,
    choose_batch_size,
    estimate_column_bytes,
    format_gigabytes,
    measure_free_bytes,
)

PER_NODE = {"p1": 2_200, "smoothed": 5_800, "p2": 2_900}
"""Bytes of single precision that each node of an element takes: tables of the elements, and levels of multigrid. The
arrays were counted on the CPU, on 49,239 nodes (p1, smoothed) and 123,508 (p2), 2026-11-24."""
FIXED = 2**30
"""Bytes that the libraries' own buffers, kernels and the last level take, about."""
BUDGET = MemoryBudget()
"""What of a card's memory is taken, unless another budget is given."""


@dataclass(frozen=True)
class Needed:
    """What so many loads together take of a device, in bytes.

    Parameters
    ----------
    nodes, element
        Of the finite elements.
    device
        Where they are.
    set_up, kept, column
        At the peak of set-up; from then on; of each load that is solved together with others.
    batch
        Loads that are solved together.
    free
        Of the device, for one process.
    """

    nodes: int
    element: str
    device: Device
    set_up: int
    kept: int
    column: int
    batch: int
    free: int

    @property
    def peak(self) -> int:
        """The most at any time: a batch stands in a room that may be wider."""
        return max(self.set_up, self.kept + find_workspace_width(self.device, self.batch) * self.column)

    def __str__(self) -> str:
        loads = f"{self.batch} loads together" if self.batch > 1 else "one load at a time"
        taken, free = format_gigabytes(self.peak), format_gigabytes(self.free)
        return f"{self.nodes:,} nodes ({self.element}), {loads}: about {taken} of {self.device.name}, {free} free"

    def demand(self, budget: MemoryBudget = BUDGET) -> Needed:
        """Itself, if it fits.

        Raises
        ------
        InputError
            Naming what it takes, what is free, and what would fit.
        """
        room = budget.share * self.free
        if self.peak <= room:
            return self
        fitting = find_widest_workspace(self.device, int((room - self.kept) / self.column))
        fits = self.set_up <= room and fitting > 0
        raise InputError(f"{self}: {f'a --batch of {fitting} fits.' if fits else COARSER}")


def estimate_needed(
    anatomy: Anatomy,
    element: str | None,
    accuracy: Accuracy,
    device: str,
    batch: int | None,
    loads: int,
    share: int = 1,
) -> Needed | None:
    """What `Fem` with these takes of a card for so many loads; None on the CPU, whose memory is asked batch by batch.

    Without a `batch` it is as large as fits. `share` processes have a part of the card each.

    Raises
    ------
    InputError
        An element or a device that cannot be had.
    """
    where = find_device(device, accuracy.precision)
    if not where.on_cuda:
        return None
    space = discretise(anatomy.mesh, element)
    free = measure_free_bytes(where) // share
    inverted = _inverted(_unknowns(space, anatomy), where)
    return compute_needed(space, where, inverted, batch, loads, free)


def compute_needed(
    space: Discretisation,
    device: Device,
    inverted: int,
    batch: int | None,
    loads: int,
    free: int,
    budget: MemoryBudget = BUDGET,
) -> Needed:
    """Return the same of elements whose preconditioner inverts so many unknowns, on a card with `free` bytes."""
    rows, width = 3 * space.count, wp.types.type_size_in_bytes(device.scalar)
    tables = FIXED + PER_NODE[space.element] * space.count * width // 4
    taken, left = _inverse_bytes(inverted, device)
    column = estimate_column_bytes(rows, device)
    if batch is None:
        batch = choose_batch_size(rows, device, free - tables - left, budget)
    return Needed(
        len(space.mesh.nodes), space.element, device, tables + taken, tables + left, column, min(batch, loads), free
    )


def _unknowns(space: Discretisation, anatomy: Anatomy) -> tuple[int, ...]:
    """How many a preconditioner may invert, the most first: of all nodes, or of the corners alone."""
    corners = int((~anatomy.held).sum())
    return (int((~space.held(anatomy.held)).sum()), corners) if space.element == "p2" else (corners,)


def _inverted(unknowns: tuple[int, ...], device: Device) -> int:
    """How many of them the card inverts, if any."""
    from ..linalg.dense_inverse import can_invert

    last = 6 * Preconditioning().largest_last
    return next((count for count in unknowns if can_invert(count, device)), last)


def _inverse_bytes(unknowns: int, device: Device) -> tuple[int, int]:
    """What an inverse takes while it is made, and what is left of that."""
    from ..linalg.block_inverse import exchange_bytes
    from ..linalg.dense_inverse import estimate_inverse_bytes

    left = estimate_inverse_bytes(unknowns, device)
    return exchange_bytes(unknowns) + left, left

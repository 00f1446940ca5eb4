"""Solvers of a data set's loads: FEM in this process, or in one process for each of several devices."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Deformer
from sim.effects import Effect, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.runtime.memory import check_fits
from sim.runtime.processes import process_pool, run_on_each
from sim.strategy.memory_needed import MemoryEstimate, estimate_fem_memory

from .load_histories import get_relaxation_series, solve_histories
from .strokes import STROKE_LENGTH, solve_strokes
from .tasks import SolverPool


@dataclass(frozen=True, eq=False)
class LazyFem:
    """`Deformer` that builds its FEM on first use.

    Parameters
    ----------
    anatomy, effects, accuracy, element, batch, device
        See `Fem`.
    load_count
        Number of loads that will be solved.
    process_count
        Number of processes that share the device.
    """

    anatomy: Anatomy
    effects: tuple[Effect, ...]
    accuracy: Accuracy
    element: str | None
    batch: int | None
    load_count: int
    device: str = "auto"
    process_count: int = 1

    @cached_property
    def fem(self) -> Fem:
        """FEM of the anatomy, built on first use."""
        return Fem(self.anatomy, self.effects, self.accuracy, self.device, self.batch, self.element)

    @property
    def required_memory(self) -> MemoryEstimate | None:
        """Estimate of the required GPU memory; None on the CPU."""
        return estimate_fem_memory(
            self.anatomy, self.element, self.accuracy, self.device, self.batch, self.load_count, self.process_count
        )

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Solve as `Fem.deform`; poses in relaxing tissue as histories, others as strokes (`solve_strokes`)."""
        if start is None and loads.get(Touching) is not None:
            if get_relaxation_series(self.effects):
                result = solve_histories(self.fem, loads)
            else:
                result = solve_strokes(self.fem, loads)
            return result if at is None else result.restrict(at)
        return self.fem.deform(loads, start, at)


@dataclass(frozen=True, eq=False)
class Solver:
    """Deformer for the loads of a data set, with its element, its description, and the number of loads per batch."""

    deformer: Deformer | SolverPool
    element: str
    description: str
    batch_size: int


@contextmanager
def open_solvers(fem: LazyFem, devices: Sequence[str], write_message: Callable[[str], object]) -> Iterator[Solver]:
    """Open FEM solvers on each of the devices, as a context manager; one device is used in this process.

    If `fem.batch` is None, the largest batch size that fits in memory is used, and GPUs get equal numbers of batches.
    `write_message` first receives a description of the memory that each GPU requires.

    Raises
    ------
    InputError
        See `Fem`, or a GPU has too little memory.
    LostProcessError
        A process was killed.
    """
    if len(devices) == 1:
        own = replace(fem, device=devices[0])
        _check_all_fit([own.required_memory], write_message)
        yield Solver(own, *describe_fem_task(own, None))
        return
    most, own = max(devices.count(name) for name in devices), -(-fem.load_count // len(devices))
    with process_pool(devices, place_on_device, replace(fem, process_count=most, load_count=own)) as children:
        none = [None] * len(devices)
        _check_all_fit(run_on_each(children, estimate_memory, none), write_message)
        elements, words, batches = zip(*run_on_each(children, describe_fem_task, none), strict=True)
        batch = min(batches)
        if fem.batch is None and devices[0].startswith("cuda"):
            batch = choose_even_batch(batch // most, fem.load_count, len(devices))
        yield Solver(SolverPool(fem.anatomy, children), elements[0], words[0], batch)


def place_on_device(device: str, fem: LazyFem) -> LazyFem:
    """Return a copy of the FEM for another device."""
    return replace(fem, device=device)


def estimate_memory(fem: LazyFem, task: None) -> MemoryEstimate | None:
    """Return the estimate of the GPU memory that the FEM needs; None on the CPU."""
    return fem.required_memory


def describe_fem_task(asked: LazyFem, task: None) -> tuple[str, str, int]:
    """Check that the FEM fits in memory, and return its element, description and batch size."""
    if asked.required_memory is None:  # on the CPU: before a file is created that keeps its batch
        fem = asked.fem
        check_fits(
            fem.problem.rows, fem.batch, min(fem.batch, asked.load_count), fem.problem.device, fem.strategy.kept_bytes
        )
    size = asked.fem.batch
    if size == 1 and any(isinstance(effect, ToolContact) for effect in asked.effects):
        size = asked.batch or STROKE_LENGTH
    return asked.fem.space.element, asked.fem.description, size


def choose_even_batch(max_batch: int, load_count: int, device_count: int) -> int:
    """Return the batch size <= `max_batch` that gives all devices equally many batches; the last may be smaller."""
    rounds = -(-load_count // (max(max_batch, 1) * device_count))
    return max(1, -(-load_count // (max(rounds, 1) * device_count)))


def _check_all_fit(estimates: Sequence[MemoryEstimate | None], write_message: Callable[[str], object]) -> None:
    for each in dict.fromkeys(map(str, filter(None, estimates))):
        write_message(f"{each}.")
    for each in filter(None, estimates):
        each.check_fits()

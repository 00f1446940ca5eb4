"""Time and memory of a load over mesh size; each size and batch is measured in a separate process."""

import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from scenes.analysis.loglog_chart import ChartPanel, Curve
from scenes.analysis.measurement import time_work, watch_gpu_memory
from scenes.report.finite_elements import build_template_mesh
from sim.accuracy import TRAIN
from sim.bodies.meshfile import read_anatomy
from sim.effects import build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.material import BRAIN
from sim.runtime.processes import LostProcessError, map_parallel
from sim.strategy.memory_needed import estimate_fem_memory
from surrogate.data.tool_loads import draw

# Number of loads, or of seconds, after which no further batch is solved.
LOADS, PATIENCE = 12, 60.0
SEED = 4


@dataclass(frozen=True)
class ScalingRow:
    """Time and memory of loads on one mesh, in batches of one size.

    Parameters
    ----------
    size, asked
        Requested number of nodes, and batch size.
    nodes, tets, preconditioner, batch
        Actual numbers of nodes and tetrahedra, preconditioner, and batch size.
    set_up, load
        Time of the set-up, and of each load [s].
    outer
        Median number of outer steps.
    loads, converged
        Number of solved loads, and number of these that converged.
    memory, card
        Peak memory of the process, and its peak memory on the GPU [GiB].
    foreseen
        Estimate of the GPU memory before the measurement [GiB].
    """

    size: int
    asked: int
    nodes: int
    tets: int
    preconditioner: str
    batch: int
    set_up: float
    load: float
    outer: float
    loads: int
    converged: int
    memory: float
    card: float
    foreseen: float


@dataclass(frozen=True)
class MeshTrial:
    """Solver under test: element, device, and folder of stored meshes."""

    element: str
    device: str
    folder: Path


def measure_mesh(trial: MeshTrial, node_count: int, batch_size: int) -> ScalingRow:
    """Solve palpation loads on one mesh, to 1e-4 in single precision, in this process.

    Raises
    ------
    InputError
        See `Fem`; a GPU with too little memory.
    """
    anatomy = read_anatomy(build_template_mesh(trial.folder, node_count))
    needed = estimate_fem_memory(anatomy, trial.element, TRAIN, trial.device, batch_size, batch_size)
    if needed is not None:
        print(f"{needed}.", file=sys.stderr)
        needed.check_fits()
    with watch_gpu_memory(trial.device) as card:
        effects = build_push_effects(anatomy, BRAIN)
        fem, made = time_work(Fem, anatomy, effects, TRAIN, trial.device, batch_size, trial.element)
        loads = draw("palpation", anatomy, max(LOADS, batch_size) + 1, SEED)
        fem.deform(loads.select(np.array([-1])).scale(1e-3))  # kernels are compiled or loaded at their first launch
        seconds, outer, good = [], [], 0
        while sum(seconds) < PATIENCE and len(outer) + batch_size <= max(LOADS, batch_size):
            some = loads.select(np.arange(len(outer), len(outer) + batch_size))
            answer, spent = time_work(fem.deform, some)
            seconds.append(spent)
            outer += list(answer.iterations)
            good += sum(outcome.good for outcome in answer.outcome)
    return ScalingRow(
        size=node_count, asked=batch_size, nodes=len(anatomy.mesh.nodes), tets=len(anatomy.mesh.tets),
        preconditioner=fem.plan.preconditioner, batch=batch_size, set_up=made,
        load=float(np.median(seconds)) / batch_size, outer=float(np.median(outer)), loads=len(outer), converged=good,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, card=max(card) / 2**30,
        foreseen=0.0 if needed is None else needed.peak_bytes / 2**30,
    )  # fmt: skip


def measure_meshes(
    trial: MeshTrial, node_counts: Sequence[int], batch_sizes: Sequence[int], done: Sequence[ScalingRow],
    report: Callable[[str], object],
) -> Iterator[ScalingRow]:  # fmt: skip
    """Measure a row for each size and batch that is not `done`, in a new process each; `report` receives the progress.

    Raises
    ------
    InputError
        Invalid meshes or devices, too little memory; a process that was killed, most likely out of memory.
    """
    known = {(row.size, row.asked) for row in done}
    for size in node_counts:
        for batch in batch_sizes:
            if (size, batch) in known:
                continue
            report(f"{size} nodes, the mesh")
            build_template_mesh(trial.folder, size)
            report(f"{size} nodes, batch of {batch}")
            try:
                yield from (row for _, row in map_parallel(partial(measure_mesh, trial, size), [batch]))
            except LostProcessError:
                raise InputError(
                    f"{size} nodes with --batch {batch}: the process was ended, for want of memory most likely; "
                    "leave this size out, or give a smaller batch."
                ) from None


def build_panels(rows: Sequence[ScalingRow]) -> tuple[ChartPanel, ...]:
    """Build the plots of time and memory over nodes, with a mark between sizes of different preconditioners."""
    batches = sorted({row.asked for row in rows})
    by_size = sorted({row.nodes: row.preconditioner for row in rows}.items())
    marks = tuple(((a * b) ** 0.5, _kind(two)) for (a, one), (b, two) in pairwise(by_size) if _kind(one) != _kind(two))

    def curve(name: str, value: str, batch: int) -> Curve:
        return Curve(name, tuple((row.nodes, getattr(row, value)) for row in rows if row.asked == batch))

    seconds = [curve("one load" if batch == 1 else f"one of {batch} together", "load", batch) for batch in batches]
    memory = [curve(f"host, batch of {batch}", "memory", batch) for batch in batches]
    if any(row.card for row in rows):
        memory += [curve(f"card, batch of {batch}", "card", batch) for batch in batches]
    first = f"left of the first mark: {by_size[0][1]}" if marks else by_size[0][1]
    seconds.append(curve("set-up", "set_up", batches[0]))
    return (
        ChartPanel("What a load takes", "nodes", f"seconds; {first}", tuple(seconds), marks),
        ChartPanel("What it needs", "nodes", f"GiB at the peak; {first}", tuple(memory), marks),
    )


def _kind(name: str) -> str:
    """Return a preconditioner's name without the number of levels."""
    return name.split(",")[0]

"""Batches of a data set, solved by one deformer in this process or by a pool of processes on several devices."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Deformer
from sim.loads import Loads, Nodal, Touching
from sim.runtime.journal import Batch
from sim.runtime.processes import ChildProcess, map_unordered

from .cortex_patch import open_patch
from .solution_rows import to_rows

# Far inside the small-strain range: 1 uN on one node of brain tissue strains its elements by some 1e-5, so that one
# solve with the undeformed stiffness is exact enough.
UNIT_FORCE = 1e-6


@dataclass(frozen=True, eq=False)
class LoadBatch:
    """Batch of a data set, with the numbers of its rows (B,) and their loads; `loads` is None for unit responses."""

    batch: Batch
    rows: np.ndarray
    loads: Loads | None


@dataclass(frozen=True, eq=False)
class SolverPool:
    """Pool of processes, each with its own deformer of the same anatomy."""

    anatomy: Anatomy
    processes: Sequence[ChildProcess]


def solve_batches(deformer: Deformer | SolverPool, tasks: Iterable[LoadBatch]) -> Iterator[tuple[LoadBatch, bytes]]:
    """Solve batches and yield each with its rows as bytes: in order without a pool, in any order with a pool."""
    if isinstance(deformer, SolverPool):
        yield from map_unordered(deformer.processes, solve_batch, tasks)
    else:
        for task in tasks:
            yield task, solve_batch(deformer, task)


def solve_batch(deformer: Deformer, task: LoadBatch) -> bytes:
    """Solve a batch from the undeformed state, independent of other batches; return its rows (`to_rows`) as bytes."""
    anatomy = deformer.anatomy
    unit = task.loads is None
    loads = build_unit_loads(anatomy, task.rows) if task.loads is None else task.loads
    result = deformer.deform(loads).restrict(np.arange(len(anatomy.mesh.nodes)))
    return to_rows(result, UNIT_FORCE if unit else 1.0, 0 if unit else count_posed_tools(loads)).tobytes()


def count_posed_tools(loads: Loads) -> int:
    """Return the number of tools that the loads move by pose, with stored reactions; 0 for pushes."""
    touching = loads.get(Touching)
    return 0 if touching is None else touching.pose.shape[1]


def build_unit_loads(anatomy: Anatomy, rows: np.ndarray) -> Loads:
    """Build loads of `UNIT_FORCE`: at open-cortex node row // 3, along axis row % 3, for each of `rows` (B,)."""
    force = np.zeros((len(rows), len(anatomy.mesh.nodes), 3))
    force[np.arange(len(rows)), open_patch(anatomy).nodes[rows // 3], rows % 3] = UNIT_FORCE
    return Loads((Nodal(force),))

"""Simulation of a data set with a deformer in batches, so that an interrupted run resumes."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Deformer
from sim.errors import InputError
from sim.loads import Loads, Touching
from sim.runtime.atomic_files import check_disk_space, check_output, write_stream_atomically
from sim.runtime.journal import Batch, DamageWarning, Journal, check_same_description, open_journal
from sim.runtime.outside_files import wrap_errors
from sim.runtime.partial_files import to_unfinished_path
from sim.runtime.processes import LostProcessError
from sim.runtime.timing import listen_to_stages, time_stage
from sim.runtime.versions import get_version

from .array_meanings import FILE_DESCRIPTION, describe_arrays
from .cortex_patch import open_patch
from .dataset import (
    FORMAT,
    OLD_FORMAT,
    compute_loads_digest,
    read_array,
    read_embedded_anatomy,
    read_loads,
    read_provenance,
    read_rows,
    write_embedded_anatomy,
    write_loads,
    write_provenance,
)
from .solution_rows import CHECKSUM_TYPE, compute_row_checksums, get_row_dtype
from .tasks import LoadBatch, SolverPool, count_posed_tools, solve_batches

STAGES = {"unit": "unit responses", "answers": "loads"}  # Names of the file's groups in reports of their seconds.
# Lower and upper bound of the HDF5 version: from v108 on, metadata of arrays have checksums.
HDF5_VERSIONS = ("v108", "v108")
UNKNOWN_RATE = "not known"  # width of a formatted number
RATE_KEYS = {"unit": "seconds a unit response", "answers": "seconds a load"}  # Provenance keys of the solver's rates.
CREATION_KEYS = ("date", *RATE_KEYS.values())
"""Provenance keys whose values differ each time a data set is created."""
T = TypeVar("T")  # Type of the solved rows.


@dataclass(frozen=True)
class SimulatedRows:
    """Numbers of unit responses and loads that one call solved, and the wall time [s] of each, writing included."""

    unit_count: int = 0
    load_count: int = 0
    unit_seconds: float = 0.0
    load_seconds: float = 0.0

    @property
    def total(self) -> int:
        """Total number of rows that the call solved."""
        return self.unit_count + self.load_count


@dataclass(frozen=True, eq=False)
class SimulationPlan:
    """Unit responses and loads to solve, divided into batches.

    Parameters
    ----------
    anatomy
        Anatomy to solve.
    loads
        Loads to solve.
    nodes
        Vertices (m,) to which a unit force is applied; empty if the loads are poses.
    batch_size
        Number of rows that are solved together.
    """

    anatomy: Anatomy
    loads: Loads
    nodes: np.ndarray
    batch_size: int

    def get_row_type(self, group: str) -> np.dtype:
        """Return the dtype of the rows of a group, `unit` or `answers`."""
        return get_row_dtype(len(self.anatomy.mesh.nodes), count_posed_tools(self.loads) if group == "answers" else 0)

    @property
    def row_counts(self) -> dict[str, int]:
        """Number of rows of each group, `unit` and `answers`."""
        return {"unit": 3 * len(self.nodes), "answers": len(self.loads)}

    @property
    def batches(self) -> list[Batch]:
        """Batches, each as its group and first row."""
        return [(name, first) for name, rows in self.row_counts.items() for first in range(0, rows, self.batch_size)]

    def list_rows(self, batch: Batch) -> np.ndarray:
        """Return the row numbers of a batch."""
        name, first = batch
        return np.arange(first, min(first + self.batch_size, self.row_counts[name]))

    def build_task(self, batch: Batch) -> LoadBatch:
        """Build the task that solves a batch, with its rows and loads."""
        rows = self.list_rows(batch)
        return LoadBatch(batch, rows, None if batch[0] == "unit" else self.loads.select(rows))


def simulate(
    path: str | Path, deformer: Deformer | SolverPool, loads: Loads, provenance: Mapping[str, str], batch: int = 64,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SimulatedRows:  # fmt: skip
    """Solve all loads, and unit forces on the open cortex unless the loads are poses; write an HDF5 file.

    Finished batches are stored in `PATH.partial` (`journal`), so that an interruption loses at most one. The same call
    resumes with the same batches; apart from the date, the resulting file has the same bytes. Damaged batches are
    solved again. The HDF5 file is written last, atomically. A finished file is extended if more loads of the same
    sampling are given, and its damaged rows are solved again.

    Parameters
    ----------
    deformer
        Deformer that solves `loads` and `Nodal` loads for all vertices, or a `SolverPool` of such deformers.
    provenance
        Texts that must equal those of the interrupted run or finished file.
    progress
        Called with the number of finished rows and their total after every batch.

    Raises
    ------
    InputError
        The batch is below one, the file has other content or is being written, the folder is not writable or has too
        little space, or a solver pool lost a process.

    Warns
    -----
    DamageWarning
        Some finished rows are damaged; they are solved again.
    """
    path = Path(path)
    if batch < 1:
        raise InputError(f"a batch of {batch} solves nothing: give --batch >= 1.")
    check_output(path, path.suffix)
    posed = count_posed_tools(loads) > 0
    nodes = np.zeros(0, int) if posed else open_patch(deformer.anatomy).nodes
    stated = {**provenance, "format": FORMAT, "anatomy": deformer.anatomy.digest, "batch": str(batch)}
    stated |= {"reactions": "kept"} if posed else {}
    partial = to_unfinished_path(path)
    finished: set[Batch] = set()
    work = SimulationPlan(deformer.anatomy, loads, nodes, batch)
    if path.exists():
        before = _read_earlier_loads(path, stated, loads)
        if len(before) > len(loads):
            work = SimulationPlan(deformer.anatomy, before, nodes, batch)
        finished = _find_complete_batches(path, work)
        if not partial.exists() and not set(work.batches) - finished and _has_same_anatomy(path, work):
            return SimulatedRows()
    size = sum(work.get_row_type(group).itemsize * rows for group, rows in work.row_counts.items())
    held = partial.stat().st_size if partial.exists() else 0
    check_disk_space(path, max(size - held, 0) + size, size)
    run = {**stated, "number of loads": str(len(work.loads)), "hash of the loads": compute_loads_digest(work.loads)}
    with listen_to_stages() as seconds, open_journal(partial, run) as journal:
        try:
            solved = _fill_journal(journal, work, deformer, finished, progress)
        except LostProcessError as error:
            raise InputError(f"{error} What was solved is kept: the same command resumes.") from error
        with time_stage(STAGES["answers"]):
            _write_data_set(path, work, {**stated, **_compute_rates(path, solved, seconds)}, journal)
    partial.unlink(missing_ok=True)
    return SimulatedRows(solved["unit"], solved["answers"], *(seconds[name] for name in STAGES.values()))


def _fill_journal(
    journal: Journal, plan: SimulationPlan, deformer: Deformer | SolverPool, finished_batches: set[Batch],
    progress: Callable[[int, int], None],
) -> dict[str, int]:  # fmt: skip
    """Solve the batches that neither the journal nor the finished file has; return the numbers of solved rows."""
    known = [batch for batch in plan.batches if batch in finished_batches or batch in journal]
    total, done = sum(plan.row_counts.values()), sum(len(plan.list_rows(batch)) for batch in known)
    solved = dict.fromkeys(plan.row_counts, 0)
    progress(done, total)
    with ThreadPoolExecutor(1) as writer:
        for name in plan.row_counts:
            written: Future[None] | None = None
            with time_stage(STAGES[name]):
                left = [plan.build_task(batch) for batch in plan.batches if batch[0] == name and batch not in known]
                for task, rows in solve_batches(deformer, left):
                    if written is not None:
                        written.result()
                    written = writer.submit(journal.add, task.batch, rows)
                    solved[name] += len(task.rows)
                    done += len(task.rows)
                    progress(done, total)
                if written is not None:
                    written.result()
    return solved


def _compute_rates(path: Path, solve_counts: Mapping[str, int], seconds: Mapping[str, float]) -> dict[str, str]:
    """Compute wall times per solve [s] of the groups solved now; other groups keep the values of the finished file.

    All texts have the same width, so that the file size does not depend on the number of interruptions.
    """
    before: dict[str, str] = {}
    if path.exists():
        with h5py.File(path, "r") as file:
            before = read_provenance(file)
    rates = {}
    for name, words in RATE_KEYS.items():
        if solve_counts[name]:
            rates[words] = f"{seconds[STAGES[name]] / solve_counts[name]:.3e}"
        else:
            rates[words] = before.get(words, UNKNOWN_RATE)
    return rates


def _write_data_set(path: Path, plan: SimulationPlan, provenance: Mapping[str, str], journal: Journal) -> None:
    """Write the data set from batches in the journal and in the finished file that it replaces."""
    with write_stream_atomically(path, path.suffix) as stream, h5py.File(stream, "w", libver=HDF5_VERSIONS) as file:
        facts = {
            "title": FILE_DESCRIPTION,
            "length_unit": "m",
            "force_unit": "N",
            "frame": "RAS",
            "tool": _describe_tool(plan.loads, provenance),
            "compression": "none: packed, displacements are a sixth smaller",
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "sulcus version": get_version("sulcus"),
        }
        write_provenance(file, {**facts, **provenance})
        write_embedded_anatomy(file, plan.anatomy)
        write_loads(file, plan.loads)

        def list_array_types(group: str) -> list[tuple[str, np.dtype]]:
            return [(item, plan.get_row_type(group)[item]) for item in plan.get_row_type(group).names or ()]

        arrays = {
            (name, item): group.create_dataset(item, (rows, *kind.shape), kind.base)
            for name, rows in plan.row_counts.items()
            for group in [file.create_group(name)]
            for item, kind in [*list_array_types(name), ("checksum", CHECKSUM_TYPE)]
        }
        file["unit/node"] = np.repeat(plan.nodes, 3)
        describe_arrays(file)

        def read_rows_of_batch(batch: Batch) -> tuple[np.ndarray, np.ndarray]:
            kind = plan.get_row_type(batch[0])
            rows = np.frombuffer(journal.read(batch), kind) if batch in journal else _read_old_rows(path, plan, batch)
            return rows, compute_row_checksums(rows)

        for batch, (rows, sums) in _compute_concurrently(read_rows_of_batch, plan.batches):
            here = slice(batch[1], batch[1] + len(rows))
            for item, _ in list_array_types(batch[0]):
                arrays[batch[0], item][here] = rows[item]
            arrays[batch[0], "checksum"][here] = sums


def _compute_concurrently(function: Callable[[Batch], T], batches: Sequence[Batch]) -> Iterator[tuple[Batch, T]]:
    """Yield each batch with its result, in order, while a second thread computes the next result."""
    with ThreadPoolExecutor(1) as maker:
        coming = [maker.submit(function, batch) for batch in batches[:1]]
        for batch, following in zip(batches, [*batches[1:], None], strict=True):
            ready = coming.pop().result()
            if following is not None:
                coming.append(maker.submit(function, following))
            yield batch, ready


def _read_old_rows(path: Path, plan: SimulationPlan, batch: Batch) -> np.ndarray:
    """Read a batch's rows from a finished file, and check them for damage again."""
    with h5py.File(path, "r") as before:
        rows, good = _read_batch(before, plan, batch)
    if not good.all():
        raise InputError(f"{path}: corrupted rows were found: run the command again to recompute them.")
    return rows


def _describe_tool(loads: Loads, provenance: Mapping[str, str]) -> str:
    """Describe the tool or the force of the loads, as text for the file."""
    if loads.get(Touching) is None:
        return "a force on a round footprint that stays with the tissue: see loads/Pushed"
    return f"the rigid tool {provenance.get('shape', 'not stated')}, sizes in m, moved by pose: see loads/Touching"


def _read_batch(file: h5py.File, plan: SimulationPlan, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """Read a batch's rows from a finished file; return the rows and the mask of undamaged ones."""
    rows = plan.list_rows(batch)
    return read_rows(file, batch[0], len(plan.anatomy.mesh.nodes), int(rows[0]), int(rows[-1]) + 1)


def _read_earlier_loads(path: Path, provenance: Mapping[str, str], loads: Loads) -> Loads:
    """Read the loads of a finished file; check that its first loads and provenance equal those of this call."""
    with wrap_errors(path, "a data set", "Delete it, or choose another --out."), h5py.File(path, "r") as file:
        recorded = read_provenance(file)
        if recorded.get("format") == OLD_FORMAT:
            raise InputError(f"{path}: is of an earlier version, whose files do not go on: choose another --out.")
        check_same_description(path, recorded, provenance, "made", "")
        before = read_loads(file)
    shared = np.arange(min(len(before), len(loads)))
    if compute_loads_digest(before.select(shared)) != compute_loads_digest(loads.select(shared)):
        raise InputError(f"{path}: holds other loads than these: choose another --out.")
    return before


def _has_same_anatomy(path: Path, plan: SimulationPlan) -> bool:
    """Return True if the anatomy in a finished file is undamaged and that of the plan."""
    with h5py.File(path, "r") as file:
        try:
            return read_embedded_anatomy(file).digest == plan.anatomy.digest
        except InputError:
            return False


def _find_complete_batches(path: Path, plan: SimulationPlan) -> set[Batch]:
    """Return the batches with undamaged rows in a finished file.

    A short last batch of the file is used only if it is also the plan's last: else its rows belong to a longer batch.
    """
    held, damaged = set(), []
    with wrap_errors(path, "a data set", "Delete it, or choose another --out."), h5py.File(path, "r") as file:
        rows = {name: len(read_array(file, f"{name}/checksum", "u")) for name in plan.row_counts}
        for batch in plan.batches:
            numbers = plan.list_rows(batch)
            if numbers[-1] < rows[batch[0]] and (
                rows[batch[0]] == plan.row_counts[batch[0]] or len(numbers) == plan.batch_size
            ):
                good = _read_batch(file, plan, batch)[1]
                damaged += [f"row {row} of `{batch[0]}`" for row in numbers[~good]]
                held |= {batch} if good.all() else set()
    if damaged:
        more = f" and {len(damaged) - 5} more" if damaged[5:] else ""
        warnings.warn(
            f"{path}: {', '.join(damaged[:5])}{more}: damaged. They are solved again, and all else is kept.",
            DamageWarning,
            stacklevel=3,
        )
    return held

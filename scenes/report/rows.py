"""Measurement of the report's rows, each in its own process; measured rows are stored, and a run can be resumed."""

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from itertools import chain, groupby, product, takewhile
from pathlib import Path
from threading import BoundedSemaphore, Event
from typing import Any

import msgspec
import numpy as np

from sim.accuracy import MIN_TOLERANCE, Precision
from sim.errors import InputError
from sim.families.registry import FAMILIES
from sim.geometry.tetmesh import compute_digest
from sim.material import LAWS
from sim.runtime.atomic_files import write_atomically
from sim.runtime.device import find_device
from sim.runtime.optional_packages import require_extra
from sim.runtime.processes import LostProcessError, process_pool, run_on_each
from sim.runtime.threads import limit_to_one_thread
from surrogate.training.expansion import SERIES_MODELS
from surrogate.training.train import LEARNERS

from ..analysis.measurement import measure_peak_memory, watch_gpu_memory
from .finite_elements import (
    HALVED_MESH,
    OWN_MESH,
    STANDARD_TOLERANCE,
    FamilySpec,
    FemVariant,
    get_law_name,
    measure_elements,
    measure_family,
)
from .learner import LearnerSpec, measure_learner
from .row import ReportRow
from .study import ReportStudy

Spec = FemVariant | FamilySpec | LearnerSpec
FAMILY_NAMES = {FemVariant: "finite elements", FamilySpec: "other families", LearnerSpec: "trained models"}
"""Names of the kinds of rows, by type of specification."""


def prepare_rows(device: str, study: ReportStudy) -> ReportStudy:
    """Import all modules that the measurement of rows needs, and start Warp silently; return the study."""
    find_device("auto", "float32")
    if study.on_card:
        import_module("torch")
    return study


def measure_row(study: ReportStudy, spec: Spec) -> ReportRow:
    """Measure the row of a deformation model.

    If the model cannot be measured, the row contains only its name, and the reason as `ReportRow.state`.
    """
    try:
        if not isinstance(spec, LearnerSpec):
            with watch_gpu_memory(study.device) as taken:
                of_elements = isinstance(spec, FemVariant)
                row = measure_elements(study, spec) if of_elements else measure_family(study, spec)
            row = replace(row, card=max(taken) / 2**30 or None)
        else:
            row = _measure_on_one_core(study, spec)
    except InputError as error:
        return ReportRow(spec.name, FAMILY_NAMES[type(spec)], state=str(error))
    return replace(row, memory=measure_peak_memory())


def _measure_on_one_core(study: ReportStudy, spec: LearnerSpec) -> ReportRow:
    """Measure a trained model on one core: on several cores, small products take longer and times vary more."""
    with limit_to_one_thread():
        return measure_learner(study, spec)


ELEMENTS = ("p1", "smoothed", "p2")  # Compared finite elements.
MESHES = {"2.5k": "2500", "17k": "17000"}  # Numbers of nodes of the compared meshes, by name.
TOLERANCES = (1e-2, 1e-3, STANDARD_TOLERANCE, 1e-5, 1e-6)  # Compared solver tolerances.
Run = Callable[[ReportStudy, Spec], ReportRow]
CORES = 4  # Number of CPU cores per measured learner, which uses one; the others prepare the next process.


def list_one_factor_variants(study: ReportStudy) -> tuple[FemVariant, ...]:
    """List the FEM variant of the data set, and the variants that differ from it in one factor.

    Other meshes and precisions, and all tolerances, belong to a thorough report. The reference's element is excluded:
    it would show only its tolerance.
    """
    known = (study.element, "" if study.thorough else study.reference_element)
    meshes = {} if not study.thorough else MESHES if study.is_shipped else {"halved edges": HALVED_MESH}
    return (
        FemVariant("FEM"),
        *(FemVariant(f"FEM {name}", element=name) for name in ELEMENTS if name not in known),
        *(FemVariant(f"FEM {name}", mesh=mesh) for name, mesh in meshes.items()),
        *(
            FemVariant(f"FEM {_format_power(size)}", tolerance=size)
            for size in (TOLERANCES if study.thorough else (TOLERANCES[0], TOLERANCES[-1]))
            if size != STANDARD_TOLERANCE
        ),
        *((FemVariant("FEM float64", precision="float64"),) if study.thorough else ()),
        *((FemVariant("FEM CPU", device="cpu"),) if study.on_card else ()),
        *(FemVariant(f"FEM {law} law", law=law) for law in LAWS if law != get_law_name(study.tissue)),
    )


def list_all_combinations(study: ReportStudy) -> tuple[FemVariant, ...]:
    """List all combinations of the compared laws, elements, meshes, tolerances and precisions."""
    meshes = {OWN_MESH: OWN_MESH, **(MESHES if study.is_shipped else {"halved edges": HALVED_MESH})}
    precisions: tuple[Precision, ...] = ("float32", "float64")
    return tuple(
        FemVariant(f"FEM {law} {element} {name} {_format_power(size)} {precision}", law, element, mesh, size, precision)
        for law, element, (name, mesh), size, precision in product(
            LAWS, ELEMENTS, meshes.items(), TOLERANCES, precisions
        )
        if size >= MIN_TOLERANCE[precision]
    )


def list_family_specs() -> tuple[FamilySpec, ...]:
    """List a specification for each model family of `FAMILIES`."""
    return tuple(FamilySpec(name) for name in FAMILIES)


def list_learner_specs(series: bool = True) -> tuple[LearnerSpec, ...]:
    """List a specification for each model type of `surrogate`; power-series models are included only if `series`."""
    return tuple(LearnerSpec(name) for name in LEARNERS if series or name not in SERIES_MODELS)


def measure_in_process(free_slot: AbstractContextManager[object], study: ReportStudy, spec: Spec) -> ReportRow:
    """Measure a row in its own process, which starts immediately, and begins to measure when `free_slot` is free."""
    try:
        # Data that the study has already read are not copied to the process.
        with process_pool(["cpu"], prepare_rows, replace(study)) as children, free_slot:
            return run_on_each(children, measure_row, [spec])[0]
    except LostProcessError:
        return ReportRow(spec.name, FAMILY_NAMES[type(spec)], state="its process was killed, probably out of memory")


def measure_on_worker(study: ReportStudy, spec: Spec) -> ReportRow:
    """Measure a row on a Dask worker, or read its file. `memory` is None: one worker process measures several rows.

    Raises
    ------
    InputError
        The worker cannot read the study's files.
    """
    if not study.data.is_file():
        raise InputError(f"a worker does not see {study.data}: put it in a folder that all machines share.")
    return _get_row(study, lambda study, spec: replace(measure_row(study, spec), memory=None), spec)


def connect_scheduler(address: str, device: str) -> AbstractContextManager[Any]:
    """Return a context that yields the workers of the Dask scheduler at `address`, for "cpu" or "cuda".

    Raises
    ------
    InputError
        The scheduler cannot be reached, or Dask is not installed.
    """
    with require_extra("data", "--scheduler needs"):
        from ..episodes.workers import connect_workers
    return connect_workers(address, device)


def measure_on_workers(study: ReportStudy, specs: Sequence[Spec], address: str) -> Iterator[ReportRow]:
    """Yield a row for each of the `specs`, measured by the workers of the Dask scheduler at `address`.

    Raises
    ------
    InputError
        The scheduler ends; see also `connect_scheduler` and `measure_on_worker`.
    """
    with connect_scheduler(address, "cuda" if study.on_card else "cpu") as workers:
        from distributed.scheduler import KilledWorker

        from ..episodes.workers import describe_scheduler_end

        here = replace(study, data=study.data.resolve(), folder=study.folder.resolve())
        rows = workers.client.map(partial(measure_on_worker, here), specs, pure=False, resources=workers.needs)
        for spec, row in zip(specs, rows, strict=True):
            try:
                yield row.result()
            except KilledWorker:
                yield ReportRow(spec.name, FAMILY_NAMES[type(spec)], state="its workers were killed: out of memory?")
            except CancelledError as error:
                raise describe_scheduler_end(workers.description) from error


def measure_rows(
    study: ReportStudy,
    specs: Sequence[Spec],
    measure: Run | None = None,
    core_count: int | None = None,
    uses_gpu: bool | None = None,
) -> Iterator[ReportRow]:
    """Yield a row for each of the `specs`; rows with unchanged inputs are read from files.

    Measured rows are stored immediately. By default each row has its own process. FEM rows are measured one at a
    time; trained models are measured in parallel, one for every `CORES` CPU cores. With FEM on a GPU, FEM takes
    one of these places, and trained models are measured at the same time. If `measure` measures rows in this process,
    they are measured one at a time unless `core_count` is given.
    """
    core_count = core_count or (1 if measure else os.cpu_count() or 1)
    beside = core_count >= 2 * CORES and (study.on_card if uses_gpu is None else uses_gpu)
    stopped, groups = Event(), []
    for kind, alike in groupby(specs, type):
        together = 1 if kind is not LearnerSpec else max(1, core_count // CORES - beside)
        measuring = measure or partial(measure_in_process, BoundedSemaphore(together))
        ahead = together if core_count >= CORES else 0
        groups.append(_run_ahead(partial(_get_row, study, measuring), list(alike), ahead))
    if not beside or len(groups) < 2:
        yield from chain.from_iterable(groups)
        return
    with ThreadPoolExecutor(len(groups) - 1) as threads:
        found = [threads.submit(list, takewhile(lambda _: not stopped.is_set(), group)) for group in groups[1:]]
        try:
            yield from groups[0]
            for group in found:
                yield from group.result()
        finally:
            stopped.set()


def _run_ahead(work: Callable[[Spec], ReportRow], specs: Sequence[Spec], ahead: int) -> Iterator[ReportRow]:
    """Yield the rows in order, while up to `ahead` further rows are measured. After a stop, no further row begins."""
    waiting: deque[Future[ReportRow]] = deque()
    with ThreadPoolExecutor(ahead + 1) as threads:
        try:
            for spec in specs:
                waiting.append(threads.submit(work, spec))
                if len(waiting) > ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _get_row(study: ReportStudy, run: Run, spec: Spec) -> ReportRow:
    stem = f"{study.data.stem} {spec.name}".replace(" ", "-")
    path = study.folder / "rows" / f"{stem}.json"
    digest = _compute_row_digest(study, spec)
    kept = _read_stored_row(path, digest)
    if kept is None:
        kept = run(study, spec)
        if kept.state == "measured":
            with write_atomically(path, ".json") as unfinished:
                unfinished.write_text(json.dumps({"digest": digest, "row": asdict(kept)}))
    return kept


def _format_power(tolerance: float) -> str:
    """Format a tolerance as a power of ten, for example 0.01 as 1e-2."""
    return f"{tolerance:.0e}".replace("e-0", "e-")


def _compute_row_digest(study: ReportStudy, spec: Spec) -> str:
    stated = f"{study.digest} {study.timed} {study.device} {type(spec).__name__} {sorted(asdict(spec).items())}"
    return compute_digest(np.frombuffer(stated.encode(), np.uint8))


def _read_stored_row(path: Path, digest: str) -> ReportRow | None:
    """Read the row in a file; None if the file is missing or invalid, or if the row has other inputs."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8-sig"))
        return msgspec.convert(stored["row"], ReportRow) if stored["digest"] == digest else None
    except (OSError, ValueError, LookupError, TypeError):
        return None

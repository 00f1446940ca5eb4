"""Reference solutions for the rows, stored load by load, and FEM solutions beyond the training range."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.accuracy import TRAIN, Accuracy
from sim.bodies.refine import refine
from sim.effects import build_push_effects
from sim.fem import Fem
from sim.geometry.locate import LocatedPoints, locate
from sim.loads import Loads
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors
from surrogate.model.kept_arrays import REMEDY
from surrogate.model.npz_archive import Archive

from .study import ReportStudy

BATCH_LOADS = 16  # Number of loads solved together where a batch is faster: an interruption loses no more than these.


@dataclass(frozen=True, eq=False)
class ReferenceSolutions:
    """Solutions of n loads: displacements (n, k, 3) [m], and `good` (n,) bool, True for converged loads.

    `seconds` (n,): duration of each solve [s].
    """

    displacement: np.ndarray
    good: np.ndarray
    seconds: np.ndarray


def solve_reference(study: ReportStudy, progress: Callable[[int], object], accuracy: Accuracy | None = None) -> None:
    """Solve the test loads with the reference's element type, and store each solution at `study.read_nodes`.

    `progress` receives the number of newly available loads. Loads with a stored solution are not solved again.
    """

    def made() -> tuple[Fem, LocatedPoints]:
        body = refine(study.anatomy) if study.thorough else study.anatomy
        fem = Fem(
            body,
            build_push_effects(body, study.get_tissue_on(body)),
            accuracy or study.reference_accuracy,
            study.device,
            None,
            study.reference_element,
        )
        return fem, locate(body.mesh, study.anatomy.mesh.nodes[study.read_nodes])

    _solve_missing_loads(study, "reference", study.test_loads, made, progress)


def solve_beyond(study: ReportStudy, progress: Callable[[int], object]) -> None:
    """Solve the loads beyond the training range with the data set's FEM model; store each solution at the tumour."""

    def made() -> tuple[Fem, LocatedPoints]:
        body = study.anatomy
        fem = Fem(body, build_push_effects(body, study.get_tissue_on(body)), TRAIN, study.device, None, study.element)
        return fem, locate(body.mesh, body.mesh.nodes[body.tumour_nodes])

    _solve_missing_loads(study, "beyond", study.loads_beyond, made, progress)


def get_reference(study: ReportStudy) -> ReferenceSolutions:
    """Read the stored solutions of `solve_reference`, at `study.read_nodes`."""
    return _read_solutions(study, "reference", len(study.test_loads))


def get_solutions_beyond(study: ReportStudy) -> ReferenceSolutions:
    """Read the stored solutions of `solve_beyond`, at the tumour's vertices."""
    return _read_solutions(study, "beyond", len(study.loads_beyond))


def _solve_missing_loads(
    study: ReportStudy,
    load_kind: str,
    loads: Loads,
    build_model: Callable[[], tuple[Fem, LocatedPoints]],
    progress: Callable[[int], object],
) -> None:
    missing = np.array([row for row in range(len(loads)) if not _to_solution_path(study, load_kind, row).exists()], int)
    progress(len(loads) - len(missing))
    if not len(missing):
        return
    fem, located = build_model()
    for rows in np.array_split(missing, -(-len(missing) // min(fem.batch, BATCH_LOADS))):
        result = fem.deform(loads.select(rows))
        for row, field, outcome in zip(rows, located.interpolate(result.displacement), result.outcome, strict=True):
            with write_atomically(_to_solution_path(study, load_kind, row), ".npz") as partial:
                np.savez(partial, displacement=field, good=outcome.good, seconds=result.cost.total / len(rows))
        progress(len(rows))


def _read_solutions(study: ReportStudy, load_kind: str, count: int) -> ReferenceSolutions:
    kept = []
    for row in range(count):
        path = _to_solution_path(study, load_kind, row)
        with wrap_errors(path, "a solution of the reference", REMEDY), path.open("rb") as raw:
            names = "displacement", "good", "seconds"
            arrays = Archive(raw, REMEDY).read_arrays(names)
            kept.append([arrays[name] for name in names])
    return ReferenceSolutions(*(np.stack(part) for part in zip(*kept, strict=True)))


def _to_solution_path(study: ReportStudy, load_kind: str, row: int) -> Path:
    return study.folder / "answers" / f"{load_kind}-{study.digest}-{row:04d}.npz"

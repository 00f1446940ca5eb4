"""Row of the report: errors, milliseconds, memory, and cost of preparation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sim.loads import Loads, Pushed
from surrogate.data.encode import split_forces
from surrogate.evaluation.score import compute_statistics

from .reference import get_reference
from .study import ReportStudy

# Differences from the reference: same law, another law, the reference's own elements.
ERROR, DIFFERENCE, TOLERANCE_ALONE = "error", "model difference", "its tolerance alone"
FORCE_CLASSES = 10  # Number of classes of force.
MIN_LOADS_FOR_P99 = 1000  # Minimum number of loads for a 99th percentile.


@dataclass(frozen=True)
class ErrorSpread:
    """Mean, 95 and 99.9 percentile, and maximum of distances over load x vertex; no 99.9 percentile for few loads."""

    mean: float
    p95: float
    p999: float | None
    largest: float


@dataclass(frozen=True)
class ForceDecile:
    """A tenth of the loads by force [N]: mean and largest distance [mm], and the mean in % of the motion."""

    least: float
    greatest: float
    mean: float
    largest: float
    percent: float


@dataclass(frozen=True)
class ErrorFigures:
    """Distances between solutions: number of loads and values, in mm and in % of each load's motion, by force.

    `worst` is of each load's worst vertex, over the loads [mm].
    """

    loads: int
    values: int
    motion: float
    mm: ErrorSpread
    worst: ErrorSpread
    percent: ErrorSpread
    tenths: tuple[ForceDecile, ...]


def compute_distance_figures(distance: np.ndarray, reference: np.ndarray, force: np.ndarray) -> ErrorFigures | None:
    """Compute errors from distances (B, n) [m] to a `reference` (B, n, 3) [m] and forces (B,) [N]; None without loads.

    A load's motion is the mean displacement of its n vertices in `reference`.
    """
    if not len(distance):
        return None
    motion = np.linalg.norm(reference, axis=2).mean(axis=1)
    mm, percent = 1e3 * distance, 100.0 * distance / motion[:, None]
    parts = [rows for rows in np.array_split(np.argsort(force, kind="stable"), FORCE_CLASSES) if len(rows)]
    tenths = (
        ForceDecile(*(float(v) for v in (force[r].min(), force[r].max(), mm[r].mean(), mm[r].max(), percent[r].mean())))
        for r in parts
    )
    return ErrorFigures(
        len(distance),
        distance.size,
        1e3 * float(motion.mean()),
        ErrorSpread(*compute_statistics(mm)),
        ErrorSpread(*compute_statistics(mm.max(axis=1))),
        ErrorSpread(*compute_statistics(percent)),
        tuple(tenths),
    )


def compute_figures(result: np.ndarray, reference: np.ndarray, loads: Loads) -> ErrorFigures | None:
    """Compute the errors of `result` (B, n, 3) [m] against `reference` (B, n, 3) [m] under pushes."""
    (pushed,) = loads.get_all(Pushed)
    return compute_distance_figures(np.linalg.norm(result - reference, axis=2), reference, split_forces(pushed)[0])


def compare_with_reference(
    study: ReportStudy, result: np.ndarray, good: np.ndarray, nodes: np.ndarray
) -> ErrorFigures | None:
    """Compute the errors of solutions (n, k, 3) [m] at vertices (k,) of the test loads where both are `good` (n,)."""
    truth = get_reference(study)
    rows = np.flatnonzero(good & truth.good)
    known = np.isin(study.read_nodes, nodes)
    return compute_figures(result[rows], truth.displacement[rows][:, known], study.test_loads.select(rows))


def compute_load_errors(study: ReportStudy, result: np.ndarray, good: np.ndarray, nodes: np.ndarray) -> dict[str, Any]:
    """Compute the mean distance of each test load from the reference [mm] at vertices `nodes` (k,), in two parts.

    `load_mm`: at the tumour; `cortex_mm`: at the open cortex, empty if `nodes` lacks it. As `compare_with_reference`.
    """
    truth = get_reference(study)
    rows = np.flatnonzero(good & truth.good)
    parts = {"load_mm": study.anatomy.tumour_nodes, "cortex_mm": study.patch.nodes}
    distance = 1e3 * np.linalg.norm(
        result[rows] - truth.displacement[rows][:, np.isin(study.read_nodes, nodes)], axis=2
    )
    known = np.intersect1d(study.read_nodes, nodes)
    return {
        name: tuple(distance[:, np.isin(known, part)].mean(axis=1).tolist()) if np.isin(part, known).all() else ()
        for name, part in parts.items()
    }


def summarise_times(seconds: Sequence[float]) -> dict[str, Any]:
    """Summarise the wall times of single loads [s]."""
    ms = 1e3 * np.array(seconds)
    p99 = float(np.percentile(ms, 99.0)) if len(ms) >= MIN_LOADS_FOR_P99 else None
    low, high = np.percentile(ms, [2.5, 97.5]).tolist()
    return {"median": float(np.median(ms)), "p99": p99, "timed": len(ms), "central_ms": (low, high)}


@dataclass(frozen=True)
class ReportRow:
    """Measurements of one deformation model; None where nothing was measured.

    Parameters
    ----------
    name, family
        Name and family of the deformation model.
    state
        "measured", or the reason why not.
    against
        `ERROR`; `DIFFERENCE` for another law; `TOLERANCE_ALONE` for the reference's own elements.
    reference
        Distances from the reference on the compared loads.
    own_fem
        Distances from the FEM that it was trained on, by set of loads: "discs", "sectors", "beyond".
    flagged
        Share of each set that it marks as extrapolated.
    covered
        Share of the loads of "discs" and "beyond" whose largest error is within the bound at 0.95.
    load_mm, cortex_mm
        Mean distance from the reference of each compared load [mm], at the tumour and at the open cortex.
    pose
        Distances from the reference where the tool is moved as there, instead of pushed with the same force.
    failed
        Test loads without a solution; they are excluded from all figures.
    outcomes
        Numbers of test loads by the name of their `Outcome`.
    median, p99, central_ms
        Time per load [ms], one at a time; p99 only for at least 1,000; range of the central 95 %.
    batch_ms
        Time per load [ms] where all compared loads are solved together.
    bare
        Time per load [ms] of the trained model alone in NumPy: no bound, no limits, same kind of code for all.
    timed
        Number of timed loads.
    set_up
        Time before the first load [s].
    memory, card
        Peak memory of its process, and of the GPU [GiB].
    loads, units, series
        Numbers of FEM solves used: loads, unit responses of the open cortex, terms of the power series.
    inside
        Number of those for the tumour inside held-out discs.
    solving
        Duration of all these solves [s], if recorded.
    learning
        Duration of training [s], without the solves.
    adapt
        Time [s] to adapt to a tumour debulked by a fifth: set-up, or solves and fitting, again.
    adapted
        Distances from FEM of the debulked body after that, on held-out discs; None for FEM.
    curve
        Distances from the FEM that it was trained on, on the discs, by number of training loads.
    plan
        Description of the solvers that FEM tries for a load.
    command
        Command that computes with this model.
    """

    name: str
    family: str
    state: str = "measured"
    against: str = ERROR
    reference: ErrorFigures | None = None
    own_fem: Mapping[str, ErrorFigures] = field(default_factory=dict)
    flagged: Mapping[str, float] = field(default_factory=dict)
    covered: Mapping[str, float] = field(default_factory=dict)
    load_mm: tuple[float, ...] = ()
    cortex_mm: tuple[float, ...] = ()
    pose: ErrorFigures | None = None
    failed: int = 0
    outcomes: Mapping[str, int] = field(default_factory=dict)
    median: float | None = None
    p99: float | None = None
    central_ms: tuple[float, float] | None = None
    batch_ms: float | None = None
    bare: float | None = None
    timed: int = 0
    set_up: float | None = None
    memory: float | None = None
    card: float | None = None
    loads: int | None = None
    units: int | None = None
    series: int | None = None
    inside: int | None = None
    solving: float | None = None
    learning: float | None = None
    adapt: float | None = None
    adapted: ErrorFigures | None = None
    curve: tuple[tuple[int, ErrorFigures], ...] = ()
    plan: tuple[str, ...] = ()
    command: str = ""

    @property
    def preparation(self) -> float | None:
        """Time before the first load [s], if known: set-up, or solves and training."""
        if self.learning is None:
            return self.set_up
        return None if self.solving is None else self.learning + self.solving


def describe_reference_error(fine: bool, rows: Sequence[ReportRow]) -> str:
    """Describe the error of the reference itself, from the row of its element on the mesh with edges twice as long."""
    coarse = next((row.reference for row in rows if row.name == "FEM p2"), None)
    if not fine or coarse is None:
        return (
            "Error of the reference: not measured. Without --quick its mesh is finer, and is compared with p2 on this."
        )
    mean = coarse.mm.mean
    return (
        f"Error of the reference: p2 on edges twice as long differs from it by {mean:.2g} mm, so that its own error is "
        f"about {mean / 3.0:.2g} mm (Richardson extrapolation, if errors fall with the square of the edge)."
    )

"""Row of the report: errors, computation times, memory, and preparation time of one model."""

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
    """Mean, 95th and 99.9th percentile and maximum of distances over loads x vertices; `p999`: None for few values."""

    mean: float
    p95: float
    p999: float | None
    largest: float


@dataclass(frozen=True)
class ForceDecile:
    """Decile of the loads by force [N]: range of forces, mean and maximum distance [mm], mean in % of the motion."""

    least: float
    greatest: float
    mean: float
    largest: float
    percent: float


@dataclass(frozen=True)
class ErrorFigures:
    """Distances between two sets of solutions: numbers of loads and values, mean motion [mm], and statistics.

    `mm` and `percent` (of a load's motion) are over all values, `worst` [mm] over the loads' maxima, `tenths` by force.
    """

    loads: int
    values: int
    motion: float
    mm: ErrorSpread
    worst: ErrorSpread
    percent: ErrorSpread
    tenths: tuple[ForceDecile, ...]


def compute_distance_figures(distance: np.ndarray, reference: np.ndarray, force: np.ndarray) -> ErrorFigures | None:
    """Compute statistics of distances (B, n) [m] from a `reference` (B, n, 3) [m], by `force` (B,) [N].

    Returns None without loads. A load's motion is the mean displacement of its n vertices in `reference`.
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
    """Compute the errors of `result` (B, n, 3) [m] relative to `reference` (B, n, 3) [m] for loads that are pushes."""
    (pushed,) = loads.get_all(Pushed)
    return compute_distance_figures(np.linalg.norm(result - reference, axis=2), reference, split_forces(pushed)[0])


def compare_with_reference(
    study: ReportStudy, result: np.ndarray, converged: np.ndarray, nodes: np.ndarray
) -> ErrorFigures | None:
    """Compute errors of `result` (n, k, 3) [m] at vertices `nodes` (k,), for test loads with both solutions good."""
    truth = get_reference(study)
    rows = np.flatnonzero(converged & truth.good)
    known = np.isin(study.read_nodes, nodes)
    return compute_figures(result[rows], truth.displacement[rows][:, known], study.test_loads.select(rows))


def compute_load_errors(study: ReportStudy, result: np.ndarray, good: np.ndarray, nodes: np.ndarray) -> dict[str, Any]:
    """Compute each test load's mean distance from the reference [mm]: `load_mm` (tumour), `cortex_mm` (open cortex).

    A part is empty if `nodes` (k,) does not contain its vertices. For the arguments see `compare_with_reference`.
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
    """Return fields of a `ReportRow` in milliseconds from the wall times of single loads [s]."""
    ms = 1e3 * np.array(seconds)
    p99 = float(np.percentile(ms, 99.0)) if len(ms) >= MIN_LOADS_FOR_P99 else None
    low, high = np.percentile(ms, [2.5, 97.5]).tolist()
    return {"median": float(np.median(ms)), "p99": p99, "timed": len(ms), "central_ms": (low, high)}


@dataclass(frozen=True)
class ReportRow:
    """Measurements of one deformation model; a value is None if it was not measured.

    Parameters
    ----------
    name, family
        Name and family of the deformation model.
    state
        "measured", or the reason why the model was not measured.
    against
        `ERROR`; `DIFFERENCE` for another law; `TOLERANCE_ALONE` for the reference's own elements.
    reference
        Distances from the reference on the test loads.
    own_fem
        Distances from the FEM model of the training data, by set of loads: "discs", "sectors", "beyond".
    flagged
        Share of loads that the model marks as extrapolated, by set of loads.
    covered
        Share of the loads in "discs" and in "beyond" whose maximum error is within the 95 % bound.
    load_mm, cortex_mm
        Mean distance from the reference of each test load [mm], at the tumour and at the open cortex.
    pose
        Distances from the reference if the tool moves as in the reference, instead of pushing with the same force.
    outcomes
        Numbers of test loads by the name of their `Outcome`; NOT_FINITE loads are excluded from all errors.
    median, p99, central_ms
        Time per load [ms], solved one at a time: median, 99th percentile (None below 1,000 loads), central 95 %.
    batch_ms
        Time per load [ms] if all test loads are solved in one batch.
    timed
        Number of timed loads.
    set_up
        Set-up time before the first load [s].
    memory, card
        Peak memory [GiB] of the measuring process, and of the GPU.
    loads, units, series
        Numbers of FEM solves for training: loads, unit responses of the open cortex, terms of the power series.
    inside
        Number of unit responses for the tumour at nodes inside held-out discs.
    solving
        Duration of all FEM solves for training [s]; None if not recorded.
    learning
        Duration of training [s], without the solves.
    adapt
        Time [s] to adapt to an anatomy with a fifth of the tumour resected: new set-up, or new solves and training.
    adapted
        Distances of the adapted model from FEM of the debulked anatomy, on held-out discs; None for FEM.
    curve
        Distances from the FEM model of the training data, on held-out discs, by number of training loads.
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
    outcomes: Mapping[str, int] = field(default_factory=dict)
    median: float | None = None
    p99: float | None = None
    central_ms: tuple[float, float] | None = None
    batch_ms: float | None = None
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
        """Time before the first load [s]: set-up, or solves and training; None if not recorded."""
        if self.learning is None:
            return self.set_up
        return None if self.solving is None else self.learning + self.solving


def describe_reference_error(is_finer_mesh: bool, rows: Sequence[ReportRow]) -> str:
    """Describe the error of the reference, from the row "FEM p2" on the mesh with edges twice as long."""
    coarse = next((row.reference for row in rows if row.name == "FEM p2"), None)
    if not is_finer_mesh or coarse is None:
        return (
            "Error of the reference: not measured. Without --quick its mesh is finer, and is compared with p2 on this."
        )
    mean = coarse.mm.mean
    return (
        f"Error of the reference: p2 on edges twice as long differs from it by {mean:.2g} mm, so that its own error is "
        f"about {mean / 3.0:.2g} mm (Richardson extrapolation, if errors fall with the square of the edge)."
    )

"""Errors of a model on the loads of a data set, for displacement and tool force, and its wall time."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sim.deformation import Deformer
from sim.errors import InputError
from sim.loads import Loads
from sim.runtime.threads import limit_to_one_thread

from ..model.held_out import MIN_LOADS_FOR_P999
from ..model.learned import Learned
from .coverage import Shares, format_coverage, measure_coverage_shares


@dataclass(frozen=True)
class SolveCounts:
    """Numbers of FEM solves by kind, and their wall time.

    Parameters
    ----------
    loads
        Number of nonlinear solves, one for each training load.
    units
        Number of linear solves of unit forces at nodes of the cortex.
    series
        Number of linear solves of the power series: positions x radii x terms.
    inside
        Number of linear solves for the tumour with forces inside held-out discs.
    seconds
        Wall time of all these solves [s], on the machine that computed them; None if not recorded, or if an interrupted
        run was resumed.
    """

    loads: int
    units: int
    series: int
    inside: int
    seconds: float | None

    @property
    def total(self) -> int:
        """Total number of solves."""
        return self.loads + self.units + self.series


WARM_UP_LOADS = 10  # Number of loads solved before the timed ones.
TIMED_LOADS = 100  # Number of timed loads.
T = TypeVar("T")  # Type of a deformer's input.


@dataclass(frozen=True)
class ForceScore:
    """Error of a tool's force vector, over the n loads with a force above zero.

    Parameters
    ----------
    loads
        Number n of loads.
    force
        Mean magnitude of the FEM forces [N].
    mean
        Mean error [N].
    mean_percent, p95_percent
        Mean and 95th percentile of error / FEM force of the same load [%].
    shares
        Empirical coverage of the bound, as in `Coverage`; None without a bound.
    bound
        Median of the bound at the first level [N]; None without a bound.
    """

    loads: int
    force: float
    mean: float
    mean_percent: float
    p95_percent: float
    shares: Shares | None = None
    bound: float | None = None

    def __str__(self) -> str:
        promised = "no bounds"
        if self.shares is not None and self.bound is not None:
            promised = f"bounds cover {format_coverage(self.shares)}; median bound {self.bound:.4f} N"
        return (
            f"mean error {self.mean:.4f} N of {self.force:.3f} N, {self.mean_percent:.2f} % of each load's force, "
            f"p95 {self.p95_percent:.2f} %; {promised}"
        )


def compute_force_errors(predicted: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Compute the norms (B,) [N] of the differences between predicted and reference forces (B, 3)."""
    return np.linalg.norm(predicted - reference, axis=1)


def score_forces(error: np.ndarray, reference: np.ndarray, bounds: np.ndarray | None = None) -> ForceScore:
    """Score errors (B,) [N] of forces, given the FEM forces `reference` (B, 3) [N] and bounds (2, B) [N], if any.

    Raises
    ------
    InputError
        All reference forces are zero.
    """
    size = np.linalg.norm(reference, axis=1)
    some = size > 0.0
    if not some.any():
        raise InputError(
            "no tool presses under any of these loads, so that no force can be judged: give poses that do."
        )
    share = 100.0 * error[some] / size[some]
    if bounds is not None and np.isnan(bounds).all():
        bounds = None
    return ForceScore(
        int(some.sum()),
        float(size[some].mean()),
        float(error[some].mean()),
        float(share.mean()),
        float(np.percentile(share, 95.0)),
        measure_coverage_shares(error[some], bounds[:, some]) if bounds is not None else None,
        float(np.median(bounds[0, some])) if bounds is not None else None,
    )


def compare_forces(model: Learned, loads: Loads, reference: np.ndarray) -> ForceScore:
    """Score a model's tool forces relative to the FEM forces `reference` (B, 3) [N]."""
    result = model.deform(loads, at=model.anatomy.tumour_nodes)
    return score_forces(compute_force_errors(result.reaction[:, 0, :3], reference), reference, result.reaction_bound)


@dataclass(frozen=True)
class Score:
    """Errors of a deformer relative to FEM over all loads and vertices, and its wall time.

    Parameters
    ----------
    name
        Name of the deformer.
    mean_mm, p95_mm, p999_mm, max_mm
        Mean, percentiles and maximum of errors [mm]; p999 is None for fewer than `MIN_LOADS_FOR_P999` loads.
    mean_percent, p95_percent, p999_percent, max_percent
        The same statistics of error / mean displacement of the vertices under the same load [%].
    worst_mean_mm, worst_p95_mm, worst_p999_mm
        Mean and percentiles over loads of the maximum vertex error [mm]; the maximum over loads is `max_mm`.
    microseconds
        Median wall time of `deform` for a single load [us], with bounds and checks, without warm-up.
    bare_microseconds
        Median wall time of the model alone in NumPy [us], to compare model types; None for other deformers.
    solves
        Numbers of FEM solves that the deformer depends on; None if not available.
    """

    name: str
    mean_mm: float
    p95_mm: float
    p999_mm: float | None
    max_mm: float
    mean_percent: float
    p95_percent: float
    p999_percent: float | None
    max_percent: float
    worst_mean_mm: float
    worst_p95_mm: float
    worst_p999_mm: float | None
    microseconds: float
    bare_microseconds: float | None = None
    solves: SolveCounts | None = None


def compute_point_errors(deformer: Deformer, loads: Loads, reference: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Compute a deformer's errors (B, n) [m] relative to `reference` (B, n, 3) [m] at the vertices `nodes` (n,)."""
    return np.linalg.norm(deformer.deform(loads, at=nodes).displacement - reference, axis=2)


def score(
    name: str, deformer: Deformer, loads: Loads, truth: np.ndarray, nodes: np.ndarray, solves: SolveCounts | None = None
) -> Score:
    """Score a deformer relative to FEM displacements `truth` (B, n, 3) [m] of the vertices `nodes` (n,)."""
    distance = compute_point_errors(deformer, loads, truth, nodes)
    motion = np.linalg.norm(truth, axis=2).mean(axis=1, keepdims=True)
    return Score(
        name,
        *compute_statistics(1e3 * distance),
        *compute_statistics(100.0 * distance / motion),
        *compute_statistics(1e3 * distance.max(axis=1))[:3],
        1e6 * float(np.median(time_single_loads(deformer, loads, nodes, TIMED_LOADS))),
        time_model_alone(deformer, loads),
        solves,
    )


def time_model_alone(deformer: Deformer, loads: Loads) -> float | None:
    """Measure the median wall time [us] of a trained model alone for a single load; None for other deformers."""
    if not isinstance(deformer, Learned):
        return None
    single = [
        deformer.to_input(loads.select(slice(row, row + 1)))
        for row in np.arange(WARM_UP_LOADS + TIMED_LOADS) % len(loads)
    ]
    nodes = deformer.anatomy.tumour_nodes
    with limit_to_one_thread():
        return 1e6 * float(np.median(_measure_times(lambda one: deformer.predict_motion(one, nodes), single)))


def time_single_loads(deformer: Deformer, loads: Loads, nodes: np.ndarray, count: int) -> list[float]:
    """Measure wall times [s] of `count` solves of single loads, cycling through the loads, without warm-up."""
    single = [loads.select(slice(row, row + 1)) for row in np.arange(WARM_UP_LOADS + count) % len(loads)]
    return _measure_times(lambda one: deformer.deform(one, at=nodes), single)


def _measure_times(function: Callable[[T], object], arguments: Iterable[T]) -> list[float]:
    """Measure the wall time [s] of each call of `function`, without the warm-up calls."""
    seconds = []
    for one in arguments:
        begun = time.perf_counter()
        function(one)
        seconds.append(time.perf_counter() - begun)
    return seconds[WARM_UP_LOADS:]


def find_best_score(scores: Sequence[Score]) -> Score:
    """Return the score with the smallest mean error in mm."""
    return min(scores, key=lambda row: row.mean_mm)


def format_scores(scores: Sequence[Score], motion_mm: float) -> str:
    """Format the scores as a table, with the best one and the FEM solves of each model type, if known."""
    head = (
        "          mm, all vertices                | mm, a load's worst vertex  | % of motion                 "
        "| us, NumPy model\n"
        "learner      mean     p95   p99.9     max |    mean     p95   p99.9    |   mean    p95  p99.9    max "
        "|      | us, result with bound"
    )
    rows = [
        f"{row.name:<10}{row.mean_mm:7.4f} {row.p95_mm:7.4f} {_format_number(row.p999_mm, '7.4f')} {row.max_mm:7.4f} | "
        f"{row.worst_mean_mm:7.4f} {row.worst_p95_mm:7.4f} {_format_number(row.worst_p999_mm, '7.4f')}    |"
        f"{row.mean_percent:7.2f} {row.p95_percent:6.2f} {_format_number(row.p999_percent, '6.2f')} "
        f"{row.max_percent:6.2f} |"
        f"{'' if row.bare_microseconds is None else f'{row.bare_microseconds:.0f}':>5} |{row.microseconds:5.0f}"
        for row in scores
    ]
    best = find_best_score(scores)
    fastest = min(scores, key=lambda row: row.microseconds)
    verdict = f"{best.mean_mm:.4f} mm mean error at a mean motion of {motion_mm:.3f} mm"
    wins = f"{best.name} has the smallest error: {verdict}; {fastest.name} is fastest, {fastest.microseconds:.0f} us"
    few = [f"p99.9: not estimated from fewer than {MIN_LOADS_FOR_P999} loads"] if scores[0].p999_mm is None else []
    return "\n".join([head, *rows, *few, wins if len(scores) > 1 else f"{best.name}: {verdict}", *_list_solves(scores)])


def _format_number(value: float | None, format_spec: str) -> str:
    """Format a number by `format_spec`; None gives a dash of the same width."""
    return f"{'-':>{format_spec.split('.')[0]}}" if value is None else f"{value:{format_spec}}"


def _list_solves(scores: Sequence[Score]) -> list[str]:
    """Format the numbers of FEM solves of each model type as lines; empty if none is known."""
    known = [(row.name, row.solves) for row in scores if row.solves is not None]
    if not known:
        return []
    rows = [
        f"{name:<10}{count.loads:7d} {count.units:7d} {count.series:8d} {count.total:8d} {count.inside:9d}"
        f" {'unknown' if count.seconds is None else f'{count.seconds:.1f}':>9}"
        for name, count in known
    ]
    return [
        "finite-element solves given to the learners above, their wall time, and how many are of the tumour from "
        "inside the discs:",
        "learner     loads    unit   series      all    inside   seconds",
        *rows,
    ]


def compute_statistics(values: np.ndarray) -> tuple[float, float, float | None, float]:
    """Compute mean, 95th and 99.9th percentile (None for few loads), and maximum of values (B, ...) of B loads."""
    p95, p999 = np.percentile(values, (95.0, 99.9))
    return (
        float(values.mean()),
        float(p95),
        float(p999) if len(values) >= MIN_LOADS_FOR_P999 else None,
        float(values.max()),
    )

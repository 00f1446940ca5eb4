"""Error and time of deformers against the finite elements: one row per deformer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformer
from sim.loads import Loads

WARM_UP, TIMED = 20, 200


@dataclass(frozen=True)
class Score:
    """Distances between prediction and reference over every load x vertex.

    Parameters
    ----------
    name
        Of the deformer.
    mean_mm, p95_mm, p999_mm, max_mm
        [mm].
    mean_percent, p95_percent, p999_percent, max_percent
        Each distance divided by its load's motion, which is the mean displacement of the vertices in the reference [%].
    microseconds
        Median wall time of one load at a time, encoding included, warm-up excluded.
    """

    name: str
    mean_mm: float
    p95_mm: float
    p999_mm: float
    max_mm: float
    mean_percent: float
    p95_percent: float
    p999_percent: float
    max_percent: float
    microseconds: float


def errors(deformer: Deformer, loads: Loads, truth: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Distances (B, n) [m] between the deformer's answers and `truth` (B, n, 3) [m] at `nodes` (n,)."""
    return np.linalg.norm(deformer.deform(loads, at=nodes).displacement - truth, axis=2)


def score(name: str, deformer: Deformer, loads: Loads, truth: np.ndarray, nodes: np.ndarray) -> Score:
    """Hold a deformer to `truth` (B, n, 3) [m] at the vertices `nodes` (n,)."""
    distance = errors(deformer, loads, truth, nodes)
    motion = np.linalg.norm(truth, axis=2).mean(axis=1, keepdims=True)
    return Score(
        name,
        *spread(1e3 * distance),
        *spread(100.0 * distance / motion),
        microseconds(deformer, loads, nodes),
    )


def microseconds(deformer: Deformer, loads: Loads, nodes: np.ndarray) -> float:
    """Median wall time [us] of one load at a time."""
    return 1e6 * float(np.median(single_seconds(deformer, loads, nodes, TIMED)))


def single_seconds(deformer: Deformer, loads: Loads, nodes: np.ndarray, count: int) -> list[float]:
    """Wall times [s] of `count` answers to one load at a time, the loads in turns, warm-up excluded."""
    single = [loads.rows(slice(row, row + 1)) for row in np.arange(WARM_UP + count) % len(loads)]
    seconds = []
    for one in single:
        begun = time.perf_counter()
        deformer.deform(one, at=nodes)
        seconds.append(time.perf_counter() - begun)
    return seconds[WARM_UP:]


def winner(scores: Sequence[Score]) -> Score:
    """The score of least mean error."""
    return min(scores, key=lambda row: row.mean_mm)


def table(scores: Sequence[Score], motion_mm: float) -> str:
    """The scores for people, the winner named below."""
    head = "learner     mean     p95   p99.9     max mm |  mean    p95  p99.9    max % of motion | us each"
    rows = [
        f"{row.name:<9}{row.mean_mm:7.4f} {row.p95_mm:7.4f} {row.p999_mm:7.4f} {row.max_mm:7.4f}    |"
        f"{row.mean_percent:6.2f} {row.p95_percent:6.2f} {row.p999_percent:6.2f} {row.max_percent:6.2f}             |"
        f"{row.microseconds:8.0f}"
        for row in scores
    ]
    best = winner(scores)
    fastest = min(scores, key=lambda row: row.microseconds)
    verdict = f"{best.name} wins: {best.mean_mm:.4f} mm mean error at a mean motion of {motion_mm:.3f} mm"
    return "\n".join([head, *rows, f"{verdict}; {fastest.name} is fastest, {fastest.microseconds:.0f} us"])


def spread(values: np.ndarray) -> tuple[float, float, float, float]:
    """Mean, 95 and 99.9 percentile, and maximum."""
    p95, p999 = np.percentile(values, (95.0, 99.9))
    return float(values.mean()), float(p95), float(p999), float(values.max())

"""Convergence of random loads, from surgical tools to far beyond surgery, with a record of each load."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from sim.accuracy import NO_STRAIN_LIMIT, REFERENCE, Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome
from sim.effects import Effect
from sim.fem import Fem
from sim.loads import Loads, Pushed
from surrogate.data.tool_loads import BRUTAL, TOOLS, draw

SETS = (*TOOLS, "seed", BRUTAL.name)
# Stride of the loads whose residual is computed again in double precision.
CHECKED = 100


@dataclass(frozen=True)
class LoadRecord:
    """Load and its outcome; `double` is the residual in double precision, NaN if not computed."""

    preset: str
    number: int
    force: float
    footprint: float
    outcome: str
    outer: int
    residual: float
    double: float
    seconds: float


@dataclass(frozen=True)
class SolverTrial:
    """Solver under test: body, effects, element, device and batch size."""

    anatomy: Anatomy
    effects: tuple[Effect, ...]
    element: str
    device: str
    batch: int

    def build_fem(self, accuracy: Accuracy) -> Fem:
        """Build the FEM solver under test."""
        return Fem(self.anatomy, self.effects, accuracy, self.device, self.batch, self.element)


def divide_loads(count: int) -> dict[str, int]:
    """Divide `count` loads among the sets: half are brutal, the tools and the published protocol share the others."""
    gentle = [name for name in SETS if name != BRUTAL.name]
    whole, left = divmod(count - count // 2, len(gentle))
    return {**{name: whole + (place < left) for place, name in enumerate(gentle)}, BRUTAL.name: count // 2}


def solve_loads(trial: SolverTrial, count: int, seed: int, solved: Sequence[LoadRecord]) -> Iterator[list[LoadRecord]]:
    """Solve those of `count` loads that are not `solved`, to 1e-4 in single precision, in the batches of a whole run.

    Strains are not limited, since the solver is tested, not the tissue.
    """
    fem, double = trial.build_fem(NO_STRAIN_LIMIT), trial.build_fem(REFERENCE)
    for preset, wanted in divide_loads(count).items():
        first = sum(record.preset == preset for record in solved)
        if first >= wanted:
            continue
        loads = draw(preset, trial.anatomy, wanted, seed)
        for start in range(first // trial.batch * trial.batch, len(loads), trial.batch):
            index = np.arange(start, min(start + trial.batch, len(loads)))
            some = loads.select(index)
            answer, seconds = time_work(fem.deform, some)
            again = np.full(len(index), np.nan)
            chosen = np.flatnonzero(index % CHECKED == 0)
            if len(chosen):
                again[chosen] = double.residual(some.select(chosen), answer.select(chosen))
            yield _written(preset, index, some, answer, again, seconds / len(index))[max(first - start, 0) :]


def _written(
    preset: str, index: np.ndarray, loads: Loads, answer: Deformation, again: np.ndarray, seconds: float
) -> list[LoadRecord]:
    (pushed,) = loads.get_all(Pushed)
    force = np.linalg.norm(pushed.force, axis=1)
    return [
        LoadRecord(
            preset=preset, number=int(number), force=float(force[row]), footprint=float(pushed.footprint[row]),
            outcome=answer.outcome[row].name,
            outer=int(answer.iterations[row]), residual=float(answer.residual[row]), double=float(again[row]),
            seconds=seconds,
        )
        for row, number in enumerate(index)
    ]  # fmt: skip


@dataclass(frozen=True)
class SetStatistics:
    """Statistics of a set of loads: number converged, of these by load steps; outer steps; ms per load; hardest load.

    `double` is the largest residual in double precision among the `checked` loads.
    """

    preset: str
    loads: int
    converged: int
    rescued: int
    outer_median: float
    outer_p99: float
    milliseconds: float
    checked: int
    double: float
    hardest: LoadRecord


def summarise_sets(records: Sequence[LoadRecord]) -> list[SetStatistics]:
    """Summarise the sets, in order. The hardest load failed with the largest residual, or took the most steps."""
    out = []
    for preset in SETS:
        mine = [record for record in records if record.preset == preset]
        if not mine:
            continue
        good = [record for record in mine if Outcome[record.outcome].good]
        outer = [record.outer for record in mine]
        double = [record.double for record in mine if np.isfinite(record.double)]
        hardest = max(mine, key=lambda r: (not Outcome[r.outcome].good, r.residual if r not in good else 0.0, r.outer))
        rescued = sum(record.outcome != Outcome.CONVERGED.name for record in good)
        out.append(
            SetStatistics(
                preset=preset, loads=len(mine), converged=len(good), rescued=rescued,
                outer_median=float(np.median(outer)), outer_p99=float(np.percentile(outer, 99)),
                milliseconds=1e3 * float(np.mean([record.seconds for record in mine])), checked=len(double),
                double=max(double, default=np.nan),
                hardest=hardest,
            )
        )  # fmt: skip
    return out

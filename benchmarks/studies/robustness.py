"""How many random loads converge: from the tools of surgery to what no surgeon does, on record load by load."""

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
# One load in so many has its residual computed again in double precision.
CHECKED = 100


@dataclass(frozen=True)
class Record:
    """One load and what became of it; `double` is the residual in double precision, NaN where it was not computed."""

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
class Trial:
    """What is tried: body, effects and element, on which device, so many loads together."""

    anatomy: Anatomy
    effects: tuple[Effect, ...]
    element: str
    device: str
    batch: int

    def fem(self, accuracy: Accuracy) -> Fem:
        """The finite elements of this trial."""
        return Fem(self.anatomy, self.effects, accuracy, self.device, self.batch, self.element)


def shares(count: int) -> dict[str, int]:
    """How many of `count` loads each set gets: half are brutal, the tools and the published protocol share the rest."""
    gentle = [name for name in SETS if name != BRUTAL.name]
    whole, left = divmod(count - count // 2, len(gentle))
    return {**{name: whole + (place < left) for place, name in enumerate(gentle)}, BRUTAL.name: count // 2}


def records(trial: Trial, count: int, seed: int, done: Sequence[Record]) -> Iterator[list[Record]]:
    """Solve what is not `done` yet of `count` loads, to 1e-4 in single precision, in the batches of a whole run.

    Strains are not limited: what is measured is the solver.
    """
    fem, double = trial.fem(NO_STRAIN_LIMIT), trial.fem(REFERENCE)
    for preset, wanted in shares(count).items():
        first = sum(record.preset == preset for record in done)
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
) -> list[Record]:
    (pushed,) = loads.get_all(Pushed)
    force = np.linalg.norm(pushed.force, axis=1)
    return [
        Record(
            preset=preset, number=int(number), force=float(force[row]), footprint=float(pushed.footprint[row]),
            outcome=answer.outcome[row].name,
            outer=int(answer.iterations[row]), residual=float(answer.residual[row]), double=float(again[row]),
            seconds=seconds,
        )
        for row, number in enumerate(index)
    ]  # fmt: skip


@dataclass(frozen=True)
class Tally:
    """One set of loads: how many converged, of them after a rescue; outer steps; ms a load; the hardest one.

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
    hardest: Record


def tallies(found: Sequence[Record]) -> list[Tally]:
    """The sets that were tried, in order. The hardest load failed with the largest residual, or took the most steps."""
    out = []
    for preset in SETS:
        mine = [record for record in found if record.preset == preset]
        if not mine:
            continue
        good = [record for record in mine if Outcome[record.outcome].good]
        outer = [record.outer for record in mine]
        double = [record.double for record in mine if np.isfinite(record.double)]
        hardest = max(mine, key=lambda r: (not Outcome[r.outcome].good, r.residual if r not in good else 0.0, r.outer))
        rescued = sum(record.outcome != Outcome.CONVERGED.name for record in good)
        out.append(
            Tally(
                preset=preset, loads=len(mine), converged=len(good), rescued=rescued,
                outer_median=float(np.median(outer)), outer_p99=float(np.percentile(outer, 99)),
                milliseconds=1e3 * float(np.mean([record.seconds for record in mine])), checked=len(double),
                double=max(double, default=np.nan),
                hardest=hardest,
            )
        )  # fmt: skip
    return out

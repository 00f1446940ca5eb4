"""How many loads a second the finite elements solve: one mesh, thousands of loads, set-up off the clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.accuracy import REFERENCE, TRAIN
from sim.anatomy import Anatomy
from sim.effects import Effect, pushed_effects
from sim.fem import Fem
from sim.loads import Loads
from sim.material import Material
from surrogate.data.tool_loads import TOOLS, draw
from surrogate.data.tool_poses import draw_poses

from .robustness import CHECKED, Trial
from .stopwatch import timed

SEED = 0
# However few the loads, so many have their residual computed again in double precision.
LEAST_CHECKED = 4


# Loads of one preset, and the seconds that drawing them took.
Drawn = tuple[Loads, float]


@dataclass(frozen=True)
class Row:
    """One set of loads on one tissue.

    Parameters
    ----------
    set_up
        Seconds from the mesh to a solver; kernels are compiled in the warm-up, which nobody counts.
    converged
        Of the loads, in the worst repeat.
    steps_median, steps_p99
        Outer steps of a load.
    seconds
        Of each repeat: all loads solved, the tumour's vertices fetched.
    draw_seconds
        Of drawing the loads, apart.
    checked, double
        So many loads solved again for every vertex, and the largest of their residuals in double precision.
    """

    law: str
    poisson: float
    element: str
    nodes: int
    preconditioner: str
    set_up: float
    preset: str
    loads: int
    converged: int
    steps_median: float
    steps_p99: float
    seconds: tuple[float, ...]
    draw_seconds: float
    checked: int
    double: float

    @property
    def median(self) -> float:
        """Seconds for all loads, median of the repeats."""
        return float(np.median(self.seconds))

    @property
    def rate(self) -> float:
        """Solves a second."""
        return self.loads / self.median


@dataclass(frozen=True)
class Together:
    """The tools of surgery on one tissue: their names, all their loads, the seconds for all, and to draw them."""

    law: str
    poisson: float
    set_up: float
    presets: tuple[str, ...]
    loads: int
    seconds: float
    draw_seconds: float

    @property
    def rate(self) -> float | None:
        """Solves a second; None where no tool was asked for."""
        return self.loads / self.seconds if self.loads else None


def drawn(anatomy: Anatomy, presets: Sequence[str], count: int, posed: bool = False) -> dict[str, Drawn]:
    """`count` loads of each preset, or poses of its ball; of the published protocol no more than it has.

    Raises
    ------
    InputError
        As `draw`, or as `draw_poses`.
    """
    out, by = {}, draw_poses if posed else draw
    for preset in presets:
        by(preset, anatomy, 1, SEED)  # the cortex is measured at the first draw
        out[preset] = timed(by, preset, anatomy, count, SEED)
    return out


def rows(
    trial: Trial,
    material: Material,
    sets: Mapping[str, Drawn],
    repeats: int,
    done: Callable[[], object],
    tools: tuple[Effect, ...] = (),
) -> Iterator[Row]:
    """A row for each set of loads on one tissue under `tools`, to 1e-4 in single precision.

    `done` is called `repeats` + 2 times a row: after the warm-up, after each repeat, and after the check.

    Raises
    ------
    InputError
        As `Fem`.
    """
    trial = replace(trial, effects=(*pushed_effects(trial.anatomy, material), *tools))
    fem, set_up = timed(trial.fem, TRAIN)
    # Judged on the host whatever the device: other kernels and other arithmetic than those that are measured.
    judge = replace(trial, device="cpu", batch=CHECKED).fem(REFERENCE)
    for preset, (loads, drawing) in sets.items():
        fem.deform(loads.rows(slice(trial.batch)), at=trial.anatomy.tumour_nodes)
        done()
        seconds, converged = [], []
        steps = np.zeros(0)
        for _ in range(repeats):
            answer, spent = timed(fem.deform, loads, at=trial.anatomy.tumour_nodes)
            converged.append(sum(outcome.good for outcome in answer.outcome))
            seconds.append(spent)
            steps = answer.iterations
            done()
        again = _double(fem, judge, loads)
        done()
        yield Row(
            material.law, material.poisson, trial.element, fem.space.count, fem.plan.preconditioner, set_up, preset,
            len(loads), min(converged), float(np.median(steps)), float(np.percentile(steps, 99)), tuple(seconds),
            drawing, len(again), float(again.max()),
        )  # fmt: skip


def together(found: Sequence[Row]) -> list[Together]:
    """The tools of surgery taken together, tissue by tissue."""
    out = []
    for law, poisson in dict.fromkeys((row.law, row.poisson) for row in found):
        mine = [row for row in found if (row.law, row.poisson) == (law, poisson)]
        tools = [row for row in mine if row.preset in TOOLS]
        loads, seconds = sum(row.loads for row in tools), sum(row.median for row in tools)
        drawing = sum(row.draw_seconds for row in tools)
        out.append(Together(law, poisson, mine[0].set_up, tuple(row.preset for row in tools), loads, seconds, drawing))
    return out


def _double(fem: Fem, judge: Fem, loads: Loads) -> np.ndarray:
    """The residuals in double precision (k,) of `checked` loads, solved for every vertex."""
    chosen = loads.rows(checked(len(loads)))
    return judge.residual(chosen, fem.deform(chosen))


def checked(count: int) -> np.ndarray:
    """Which (k,) of so many loads are checked: one in a hundred, evenly picked."""
    return np.linspace(0, count - 1, min(count, max(LEAST_CHECKED, -(-count // CHECKED)))).astype(int)

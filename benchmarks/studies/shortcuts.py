"""Speed-up by each acceleration of the solver: the same loads with it and without it, alternately."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenes.analysis.measurement import time_work
from scenes.script.craniotomy_frame import CraniotomyFrame
from scenes.script.scene import find_scene
from sim.accuracy import LIVE, TRAIN, Accuracy
from sim.effects import Effect, ToolContact, build_push_effects
from sim.fem import Fem
from sim.loads import Loads
from sim.material import BRAIN
from sim.strategy.plan import SolverStep
from surrogate.data.tool_loads import draw
from surrogate.data.tool_poses import choose_ball, draw_poses

SEED = 4
BATCH, BATCH_ON_CUDA, POSES = 32, 2048, 16


@dataclass(frozen=True, eq=False)
class ShortcutCase:
    """Typical loads, and the acceleration that they test.

    Parameters
    ----------
    shortcut
        Description of the acceleration.
    name
        Description of the loads.
    step
        Solver that is disabled; None: warm-start data are dropped.
    loads
        Batches of loads, in order.
    effects, accuracy, element, live
        Arguments of `Fem`.
    follows
        True if each load starts from the last result.
    """

    shortcut: str
    name: str
    step: SolverStep | None
    loads: Sequence[Loads]
    effects: tuple[Effect, ...]
    accuracy: Accuracy = TRAIN
    element: str | None = None
    live: bool = False
    follows: bool = False


@dataclass(frozen=True)
class ShortcutRow:
    """Median and 95th percentile [ms] of a load or batch with and without an acceleration; number of timings."""

    shortcut: str
    work: str
    runs: int
    median: float
    p95: float
    median_without: float
    p95_without: float
    total: float
    total_without: float

    @property
    def ratio(self) -> float:
        """Ratio of the median without to the median with the acceleration."""
        return self.median_without / self.median

    @property
    def ratio_of_totals(self) -> float:
        """Ratio of the total times without and with the acceleration, which includes rare slow loads."""
        return self.total_without / self.total


def list_cases(site: CraniotomyFrame, run_count: int, on_cuda: bool) -> Iterator[ShortcutCase]:
    """Yield the loads to be measured; the first load of each is a warm-up."""
    anatomy, some = site.anatomy, BATCH_ON_CUDA if on_cuda else BATCH
    pushed = build_push_effects(anatomy, BRAIN)
    loads = draw("palpation", anatomy, run_count + 1, SEED)
    single = [loads.select(np.array([row])) for row in range(len(loads))]
    many = draw("palpation", anatomy, some * (run_count + 1), SEED)
    batches = [many.select(np.arange(first, first + some)) for first in range(0, len(many), some)]
    for element in ("smoothed", "p1"):
        name = f"{some} palpation loads together, {element}"
        yield ShortcutCase(
            "nonlinear elimination near the opening", name, SolverStep.NEAR, batches, pushed, element=element
        )
    name = "a palpation load from rest, quadratic"
    yield ShortcutCase("nonlinear elimination, clamped", name, SolverStep.CLAMPED, single, pushed, element="p2")
    yield ShortcutCase("L-BFGS before Newton", "a palpation load from rest", SolverStep.LBFGS, single, pushed)
    poses = draw_poses("palpation", anatomy, POSES * (run_count + 1), SEED)
    together = [poses.select(np.arange(first, first + POSES)) for first in range(0, len(poses), POSES)]
    tool = (*pushed, ToolContact((choose_ball("palpation"),)))
    yield ShortcutCase("contact solved apart", f"{POSES} poses of a ball together", SolverStep.CONTACT, together, tool)
    for scene, step, shortcut in (
        ("press", SolverStep.STRAINED, "a stiffness that knows strained tissue"),
        ("palpate", SolverStep.CONTACT, "contact solved apart"),
        ("press", None, "curvature of the last frame"),
        ("press", SolverStep.FRAME, "frame as one captured graph"),
    ):
        played = find_scene(scene)
        effects, first = played.get_effects_on(anatomy), len(played.times) // 3  # frames with the tool in contact
        frames = [
            played.build_loads(site, played.path(time), time)
            for time in played.times[first : first + run_count + 1].tolist()
        ]
        name = f"frames of `{scene}`, smoothed"
        yield ShortcutCase(shortcut, name, step, frames, effects, LIVE, live=True, follows=True)


def is_shortcut_used(fem: Fem, step: SolverStep | None) -> bool:
    """Return True if a solver uses an acceleration on its device, with its element and effects."""
    plan = fem.plan
    own = {plan.batch_solver, plan.single_solver, plan.contact_solver}
    return (
        step is None
        or step in own
        or (plan.uses_lbfgs and step is SolverStep.LBFGS)
        or (plan.captures_frames and step is SolverStep.FRAME)
    )


def measure_case(case: ShortcutCase, site: CraniotomyFrame, device: str) -> ShortcutRow | None:
    """Time loads with and without an acceleration, alternately; None if the solver does not use it."""
    avoid = () if case.step is None else (case.step,)
    batch = len(case.loads[0])
    fem, without = (
        Fem(site.anatomy, case.effects, case.accuracy, device, batch, case.element, case.live, out)
        for out in ((), avoid)
    )
    if not is_shortcut_used(fem, case.step):
        return None
    both = zip(_timed(fem, case, True), _timed(without, case, case.step is not None), strict=True)
    seconds = 1e3 * np.array(list(both)[1:]).T
    (median, other), (p95, other_p95) = np.median(seconds, axis=1), np.percentile(seconds, 95, axis=1)
    return ShortcutRow(
        case.shortcut, case.name, seconds.shape[1], *map(float, (median, p95, other, other_p95, *seconds.sum(1)))
    )


def _timed(fem: Fem, work: ShortcutCase, warm: bool) -> Iterator[float]:
    """Measure the time [s] of each load."""
    last = None
    for loads in work.loads:
        answer, seconds = time_work(fem.deform, loads, last)
        yield seconds
        if work.follows and all(outcome.good for outcome in answer.outcome):
            last = answer if warm else replace(answer, warm={})

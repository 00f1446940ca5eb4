"""Loads per second that FEM solves: one mesh, thousands of loads, without set-up."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from scenes.analysis.measurement import time_work
from sim.accuracy import NO_STRAIN_LIMIT, REFERENCE
from sim.anatomy import Anatomy
from sim.deformation import Deformation
from sim.effects import Effect, build_push_effects
from sim.fem import Fem
from sim.loads import Loads
from sim.material import Material
from sim.runtime.device import find_device
from sim.runtime.processes import process_pool, run_on_each
from surrogate.data.tool_loads import TOOLS, draw
from surrogate.data.tool_poses import draw_poses

from .robustness import CHECKED, SolverTrial

SEED = 0
# Minimum number of loads whose residual is computed again in double precision.
LEAST_CHECKED = 4


# Loads of one preset, and the time of their sampling [s].
Drawn = tuple[Loads, float]


@dataclass(frozen=True)
class ThroughputRow:
    """Results of one set of loads on one tissue.

    Parameters
    ----------
    devices
        Number of devices, each of which solves all loads at the same time; `loads` counts those of all devices.
    set_up
        Time [s] from the mesh to a solver, without the compilation of kernels in the warm-up.
    converged
        Number of converged loads in the worst repeat.
    steps_median, steps_p99
        Outer steps of a load: median and 99th percentile.
    seconds
        Time of each repeat: all loads solved, the tumour's vertices fetched. From the first device's start to the last
        one's end.
    draw_seconds
        Time to sample the loads, not included above.
    checked, double
        Number of loads solved again for every vertex, and their largest residual in double precision.
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
    devices: int = 1

    @property
    def median(self) -> float:
        """Time for all loads [s], median of the repeats."""
        return float(np.median(self.seconds))

    @property
    def rate(self) -> float:
        """Solves per second."""
        return self.loads / self.median


@dataclass(frozen=True)
class ToolsRow:
    """Surgical tools on one tissue: their names, number of loads, time for all, and time to sample them [s]."""

    law: str
    poisson: float
    set_up: float
    presets: tuple[str, ...]
    loads: int
    seconds: float
    draw_seconds: float

    @property
    def rate(self) -> float | None:
        """Solves per second; None if no tool was requested."""
        return self.loads / self.seconds if self.loads else None


def sample_loads(anatomy: Anatomy, presets: Sequence[str], count: int, with_poses: bool = False) -> dict[str, Drawn]:
    """Sample `count` loads of each preset, or poses of its ball; the published protocol may have fewer.

    Raises
    ------
    InputError
        See `draw` and `draw_poses`.
    """
    out, by = {}, draw_poses if with_poses else draw
    for preset in presets:
        by(preset, anatomy, 1, SEED)  # exclude the first call, which prepares the cortex
        out[preset] = time_work(by, preset, anatomy, count, SEED)
    return out


@dataclass(frozen=True, eq=False)
class BuiltFem:
    """FEM solver of a trial, and its set-up time [s]."""

    fem: Fem
    set_up: float


@dataclass(frozen=True, eq=False)
class Repeat:
    """Times at which all loads of a set were begun and solved, on a clock common to all processes [s]; outcomes."""

    start_time: float
    end_time: float
    converged: int
    steps: np.ndarray


# Function from work and task to the result of each device.
Asked = Callable[[Callable[[BuiltFem, Any], Any], Any], list[Any]]


@contextmanager
def open_solvers(devices: Sequence[str], trial: SolverTrial) -> Iterator[Asked]:
    """Open a FEM solver on each device for simultaneous work; with one device, the solver is in this process.

    Raises
    ------
    InputError
        As `Fem`.
    LostError
        A process that was killed.
    """
    if len(devices) == 1:
        own = build_trial_fem(devices[0], trial)
        yield lambda work, task: [work(own, task)]
        return
    with process_pool(devices, build_trial_fem, trial) as children:
        yield lambda work, task: run_on_each(children, work, [task] * len(children))


def build_trial_fem(device: str, trial: SolverTrial) -> BuiltFem:
    """Build the FEM solver of a trial on a device, in single precision."""
    find_device(device, NO_STRAIN_LIMIT.precision)  # starts Warp, not timed
    return BuiltFem(*time_work(replace(trial, device=device).build_fem, NO_STRAIN_LIMIT))


def describe_solver(built: BuiltFem, task: None) -> tuple[int, str, float]:
    """Return the number of nodes, the preconditioner, and the set-up time [s]."""
    return built.fem.space.count, built.fem.plan.preconditioner, built.set_up


def prepare_solver(built: BuiltFem, loads: Loads) -> None:
    """Solve once as a warm-up, not timed."""
    built.fem.deform(loads, at=built.fem.anatomy.tumour_nodes)


def solve_all(built: BuiltFem, loads: Loads) -> Repeat:
    """Solve all loads, and fetch the tumour's vertices."""
    wp.synchronize()
    begun = time.monotonic()
    answer = built.fem.deform(loads, at=built.fem.anatomy.tumour_nodes)
    wp.synchronize()
    good = sum(outcome.good for outcome in answer.outcome)
    return Repeat(begun, time.monotonic(), good, answer.iterations)


def solve_full(built: BuiltFem, loads: Loads) -> Deformation:
    """Solve for every vertex."""
    return built.fem.deform(loads)


def measure_rates(
    trial: SolverTrial, material: Material, load_sets: Mapping[str, Drawn], repeat_count: int,
    on_step: Callable[[], object], tools: tuple[Effect, ...] = (), devices: Sequence[str] = (),
) -> Iterator[ThroughputRow]:  # fmt: skip
    """Measure a row for each set of loads on one tissue under `tools`, to 1e-4 in single precision.

    Each of the `devices`, by default the trial's, has a process and solves all loads of a set. `on_step` is called
    `repeat_count` + 2 times a row: after the warm-up, after each repeat, and after the check.

    Raises
    ------
    InputError
        See `open_solvers`.
    """
    trial = replace(trial, effects=(*build_push_effects(trial.anatomy, material), *tools))
    with open_solvers(devices or (trial.device,), trial) as asked:
        known = asked(describe_solver, None)
        nodes, preconditioner, _ = known[0]
        # Residuals are computed on the host for every device: with kernels and arithmetic other than the measured ones.
        judge = replace(trial, device="cpu", batch=CHECKED).build_fem(REFERENCE)
        for preset, (loads, drawing) in load_sets.items():
            asked(prepare_solver, loads.select(slice(trial.batch)))
            on_step()
            seconds, converged = [], []
            steps = np.zeros(0)
            for _ in range(repeat_count):
                found: list[Repeat] = asked(solve_all, loads)
                seconds.append(max(each.end_time for each in found) - min(each.start_time for each in found))
                converged.append(sum(each.converged for each in found))
                steps = np.concatenate([each.steps for each in found])
                on_step()
            chosen = loads.select(select_checked(len(loads)))
            again = np.concatenate([judge.residual(chosen, answer) for answer in asked(solve_full, chosen)])
            on_step()
            yield ThroughputRow(
                law=material.law, poisson=material.poisson, element=trial.element, nodes=nodes,
                preconditioner=preconditioner,
                set_up=max(set_up for _, _, set_up in known), preset=preset, loads=len(known) * len(loads),
                converged=min(converged),
                steps_median=float(np.median(steps)), steps_p99=float(np.percentile(steps, 99)),
                seconds=tuple(seconds), draw_seconds=drawing, checked=len(again),
                double=float(again.max()), devices=len(known),
            )  # fmt: skip


def combine_rows(rows: Sequence[ThroughputRow]) -> list[ToolsRow]:
    """Combine the rows of surgical tools, tissue by tissue."""
    out = []
    for law, poisson in dict.fromkeys((row.law, row.poisson) for row in rows):
        mine = [row for row in rows if (row.law, row.poisson) == (law, poisson)]
        tools = [row for row in mine if row.preset in TOOLS]
        loads, seconds = sum(row.loads for row in tools), sum(row.median for row in tools)
        drawing = sum(row.draw_seconds for row in tools)
        out.append(ToolsRow(law, poisson, mine[0].set_up, tuple(row.preset for row in tools), loads, seconds, drawing))
    return out


def select_checked(count: int) -> np.ndarray:
    """Select the numbers (k,) of the loads that are checked: one in a hundred, evenly spaced."""
    return np.linspace(0, count - 1, min(count, max(LEAST_CHECKED, -(-count // CHECKED)))).astype(int)

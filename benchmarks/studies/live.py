"""Time and error of live frames: a tool moves over the open cortex, with one warm-started solve a frame."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenes.analysis.measurement import time_work
from scenes.script.craniotomy_frame import CraniotomyFrame
from scenes.script.scene import Scene
from scenes.script.tool import Probe
from scenes.script.tool_paths import stroke_cortex
from sim.accuracy import LIVE, Accuracy
from sim.deformation import Deformation
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, stack

SPEED = 20e-3
# Warm-up frames, not timed: the tool arrives, and kernels are loaded.
WARM_UP = 30
CONVERGED = Accuracy(tolerance=1e-6)


@dataclass(frozen=True)
class ToolRide:
    """Tool with a footprint of `radius` [m] that presses with `force` [N] while it moves over the open cortex."""

    name: str
    force: float
    radius: float


RIDES = (ToolRide("palpation", 0.25, 7e-3), ToolRide("spatula", 0.5, 10e-3))


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """Frame: loads, their result and the wall time [s]."""

    loads: Loads
    result: Deformation
    seconds: float


@dataclass(frozen=True)
class RideStatistics:
    """Statistics of a trajectory: time per frame [ms], outer steps, outcomes by name; errors of `checked` frames."""

    ride: str
    frames: int
    median: float
    p95: float
    p99: float
    worst: float
    steps: float
    most_steps: int
    outcomes: Mapping[str, int]
    good: bool
    checked: int
    error: float


def build_loads(ride: ToolRide, scene: Scene, site: CraniotomyFrame, frame_count: int) -> list[Loads]:
    """Build the loads of each frame, warm-up frames first.

    Raises
    ------
    InputError
        An opening in which the tool cannot move.
    """
    room = site.clearance - ride.radius
    if room <= 0.0:
        raise InputError(
            f"a {ride.name} tool of {1e3 * ride.radius:g} mm radius cannot move in an opening that is clear for "
            f"{1e3 * site.clearance:.3g} mm: choose a body with a larger craniotomy."
        )
    wandering = replace(scene, tool=Probe(radius=ride.radius), path=stroke_cortex(ride.force, room, SPEED))
    times = np.arange(WARM_UP + frame_count) / scene.frames_per_second
    return [wandering.build_loads(site, wandering.path(time), time) for time in times.tolist()]


def solve_frames(fem: Fem, loads: Sequence[Loads]) -> Iterator[LiveFrame]:
    """Yield the frames, each started from the last result; times include synchronisation with the device."""
    last = None
    for number, load in enumerate(loads):
        last, seconds = time_work(fem.deform, load, start=last)
        if number >= WARM_UP:
            yield LiveFrame(load, replace(last, memory={}, warm={}), seconds)


def build_live_fem(scene: Scene, site: CraniotomyFrame, device: str, element: str) -> Fem:
    """Build the FEM solver for live frames."""
    return Fem(site.anatomy, scene.effects, LIVE, device, element=element, live=True)


def compute_errors(frames: Sequence[LiveFrame], scene: Scene, site: CraniotomyFrame, element: str) -> np.ndarray:
    """Compute the maximum distance (n,) [m] over all nodes between each frame's result and the converged solution."""
    exact = Fem(site.anatomy, scene.effects, CONVERGED, "cpu", element=element)
    converged = exact.deform(stack([frame.loads for frame in frames])).displacement
    found = np.concatenate([frame.result.displacement for frame in frames])
    return np.linalg.norm(found - converged, axis=2).max(axis=1)


def summarise_ride(ride: ToolRide, frames: Sequence[LiveFrame], errors: np.ndarray) -> RideStatistics:
    """Summarise a trajectory's frames; `errors` (n,) [m] are the errors of the checked ones."""
    milliseconds = 1e3 * np.array([frame.seconds for frame in frames])
    steps = np.array([frame.result.iterations[0] for frame in frames])
    outcomes = [frame.result.outcome[0] for frame in frames]
    median, p95, p99, worst = np.percentile(milliseconds, [50.0, 95.0, 99.0, 100.0]).tolist()
    return RideStatistics(
        ride=ride.name,
        frames=len(frames),
        median=median,
        p95=p95,
        p99=p99,
        worst=worst,
        steps=float(steps.mean()),
        most_steps=int(steps.max()),
        outcomes=dict(Counter(outcome.name for outcome in outcomes)),
        good=all(outcome.good for outcome in outcomes),
        checked=len(errors),
        error=1e3 * float(errors.max()),
    )

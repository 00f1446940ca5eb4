"""Time of each stage: medians of short stages, without warm-up, with device synchronisation at each reading."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from scenes.play.deformers import PatientSetup
from scenes.play.player import Player
from sim.accuracy import LIVE, TRAIN
from sim.fem import Fem
from sim.resected_fem import ResectedFem
from surrogate.data.tool_loads import draw

WARM_UP = 3


@dataclass(frozen=True)
class StageRow:
    """Measured value in `unit`: median and 95th percentile of `runs` (None: one reading); `note` describes it."""

    name: str
    median: float
    p95: float | None
    unit: str
    runs: int
    note: str


def time_runs(name: str, unit: str, scale: float, run_count: int, note: str, work: Callable[[int], object]) -> StageRow:
    """Run `work(i)`, and return the row of its times [s] x scale."""
    seconds = [time_work(work, run % run_count)[1] for run in range(-WARM_UP, run_count)][WARM_UP:]
    return StageRow(
        name, scale * float(np.median(seconds)), scale * float(np.percentile(seconds, 95)), unit, run_count, note
    )


def measure_stages(
    patient: PatientSetup, player: Player, deformer: str, solve_count: int, batch_size: int,
    on_fem: Callable[[Fem | ResectedFem], object] = lambda fem: None,
) -> Iterator[StageRow]:  # fmt: skip
    """Yield the rows of a patient setup: FEM, trained models, and images of a player with a `deformer`.

    `on_fem` receives the FEM solver of the batch.
    """
    scene = player.scene
    nodes = patient.anatomy.tumour_nodes
    size = f"{len(patient.anatomy.mesh.nodes)} nodes, {len(patient.anatomy.mesh.tets)} tetrahedra"
    loads = draw("palpation", patient.anatomy, solve_count, seed=20)
    single = [loads.select(np.array([row])) for row in range(len(loads))]

    fem, seconds = time_work(patient.build_fem, scene, TRAIN, batch_size)
    seconds += time_work(fem.deform, single[0])[1]
    on_fem(fem)
    yield StageRow("FEM set-up", seconds, None, "s", 1, f"compile or load kernels, factorise; {size}")
    answers, seconds = time_work(fem.deform, loads)
    each = 1e3 * seconds / len(loads)
    good = sum(outcome.good for outcome in answers.outcome)
    note = f"{good} of {len(loads)} converged to {TRAIN.tolerance:g}; palpation loads, batches of {batch_size}"
    yield StageRow("FEM, a load in a batch", each, None, "ms", len(loads), note)
    runs = min(20, len(single))
    yield time_runs(
        "FEM, a single load", "ms", 1e3, runs, f"from rest, to {TRAIN.tolerance:g}", lambda i: fem.deform(single[i])
    )

    live = Player(player.stage, patient.build_fem(scene, LIVE, live=True))
    frames = [frame.seconds["deform"] for frame in live.play_frames()][WARM_UP:]
    yield StageRow(
        "FEM, live", 1e3 * float(np.median(frames)), 1e3 * float(np.percentile(frames, 95)), "ms", len(frames),
        f"scene {scene.name}, warm start, to {LIVE.tolerance:g}",
    )  # fmt: skip

    for name, model in patient.models.items():
        yield time_runs(
            name, "us", 1e6, 200, f"one load, all {len(nodes)} tumour nodes",
            lambda i, model=model: model.deform(single[i % len(single)], at=nodes),
        )  # fmt: skip
    times = scene.times
    size = f"{scene.viewpoint.width} x {scene.viewpoint.height}"
    yield time_runs(
        "frame", "ms", 1e3, len(times), f"deform ({deformer}), render {size}, composite: {scene.name}",
        lambda i: player.draw(i, float(times[i]), scene.path(float(times[i]))),
    )  # fmt: skip

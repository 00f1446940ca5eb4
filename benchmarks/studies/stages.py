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
class Row:
    """Measured value in `unit`: median and 95th percentile of `runs` (None: one reading); `note` describes it."""

    name: str
    median: float
    p95: float | None
    unit: str
    runs: int
    note: str


def figure(name: str, unit: str, scale: float, runs: int, note: str, work: Callable[[int], object]) -> Row:
    """Run `work(i)`, and return the row of its times [s] x scale."""
    seconds = [time_work(work, run % runs)[1] for run in range(-WARM_UP, runs)][WARM_UP:]
    return Row(name, scale * float(np.median(seconds)), scale * float(np.percentile(seconds, 95)), unit, runs, note)


def rows(
    theatre: PatientSetup,
    player: Player,
    deformer: str,
    solves: int,
    batch: int,
    made: Callable[[Fem | ResectedFem], object] = lambda fem: None,
) -> Iterator[Row]:
    """Yield the rows of a patient setup: FEM, trained models, and images of a player with a `deformer`.

    `made` receives the FEM solver of the batch.
    """
    scene = player.scene
    nodes = theatre.anatomy.tumour_nodes
    size = f"{len(theatre.anatomy.mesh.nodes)} nodes, {len(theatre.anatomy.mesh.tets)} tetrahedra"
    loads = draw("palpation", theatre.anatomy, solves, seed=20)
    single = [loads.select(np.array([row])) for row in range(len(loads))]

    fem, seconds = time_work(theatre.build_fem, scene, TRAIN, batch)
    seconds += time_work(fem.deform, single[0])[1]
    made(fem)
    yield Row("FEM set-up", seconds, None, "s", 1, f"compile or load kernels, factorise; {size}")
    answers, seconds = time_work(fem.deform, loads)
    each = 1e3 * seconds / len(loads)
    good = sum(outcome.good for outcome in answers.outcome)
    note = f"{good} of {len(loads)} converged to {TRAIN.tolerance:g}; palpation loads, batches of {batch}"
    yield Row("FEM, a load in a batch", each, None, "ms", len(loads), note)
    runs = min(20, len(single))
    yield figure(
        "FEM, a single load", "ms", 1e3, runs, f"from rest, to {TRAIN.tolerance:g}", lambda i: fem.deform(single[i])
    )

    live = Player(player.stage, theatre.build_fem(scene, LIVE, live=True))
    frames = [frame.seconds["deform"] for frame in live.play_frames()][WARM_UP:]
    yield Row(
        "FEM, live", 1e3 * float(np.median(frames)), 1e3 * float(np.percentile(frames, 95)), "ms", len(frames),
        f"scene {scene.name}, warm start, to {LIVE.tolerance:g}",
    )  # fmt: skip

    for name, model in theatre.models.items():
        yield figure(
            name, "us", 1e6, 200, f"one load, all {len(nodes)} tumour nodes",
            lambda i, model=model: model.deform(single[i % len(single)], at=nodes),
        )  # fmt: skip
    times = scene.times
    size = f"{scene.viewpoint.width} x {scene.viewpoint.height}"
    yield figure(
        "frame", "ms", 1e3, len(times), f"deform ({deformer}), render {size}, composite: {scene.name}",
        lambda i: player.draw(i, float(times[i]), scene.path(float(times[i]))),
    )  # fmt: skip

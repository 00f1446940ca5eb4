"""Energy of the built-in scenes with mass under constant loads."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from conftest import make_box

from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import SCENES, find_scene
from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, build_start
from sim.discretisation.resected_body import list_remaining_bodies
from sim.discretisation.term import Cases
from sim.effects import Effect, Elasticity, Held, Inertia, Pulsation, Resection, Wave
from sim.fem import Fem
from sim.loads import Loads, Resected
from sim.terms.inertia import compute_lumped_mass

TIGHT = Accuracy(tolerance=1e-10)
# When the load of each scene is taken that then stays [s]: something acts, and tools are in the tissue.
TAKEN = {name: 2.0 for name in SCENES} | {
    "spatula": 0.7,
    "retract": 0.8,
    "brain_shift": 5.0,
    "resection": 3.0,
    "pulsation": 3.0,
}
# How swollen tissue is as the pulse stands still: it takes weeks for one beat.
STILL, LATE = 1e-6, 2.5e5
STEPS = 12


def sliding_box() -> Anatomy:
    """A coarse box with an opening on top, held below, that slides in its skull."""
    made = make_box(cells=(6, 6, 4), spacing=12e-3)
    nodes = made.mesh.nodes
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    normal = np.where((nodes[:, 2:] == high[2]) & ~made.craniotomy[:, None], [0.0, 0.0, 1.0], 0.0)
    for axis in (0, 1):
        for side, way in ((low, -1.0), (high, 1.0)):
            normal[nodes[:, axis] == side[axis]] = way * np.eye(3)[axis]
    floor = nodes[:, 2] == low[2]
    return replace(made, fixed=np.repeat(floor[:, None], 3, axis=1), slide_normal=np.where(floor[:, None], 0.0, normal))


BODY = sliding_box()


@cache
def posed(name: str) -> tuple[Anatomy, tuple[Effect, ...], Loads, Deformation]:
    """The body, what acts without mass, the load that stays, and what the body starts from, at rest."""
    scene, time = find_scene(name), TAKEN[name]
    effects = scene.get_effects_on(BODY)
    site = build_craniotomy_frame(BODY)
    loads = scene.build_loads(site, scene.path(time), time)
    body, start = BODY, build_start(np.zeros((1, len(BODY.mesh.nodes), 3)))
    if scene.surgery is not None:  # as it was before the last cut
        stages, done = list_remaining_bodies(BODY, effects), scene.surgery.count_done(time)
        effects = (*(effect for effect in effects if not isinstance(effect, Held | Resection)), Held())
        loads, body = loads.drop(Resected), stages[done].anatomy
        before = Fem(stages[done - 1].anatomy, effects, TIGHT, "cpu", element="p1").deform(loads)
        start = build_start(np.where(body.orphaned[:, None], 0.0, before.displacement))
    if any(isinstance(effect, Pulsation) for effect in effects):
        start = replace(start, time=np.array([LATE]))
    return body, tuple(map(stilled, effects)), loads, start


def stilled(effect: Effect) -> Effect:
    """An effect whose doings depend on the time, with the same doings at any time."""
    if not isinstance(effect, Pulsation):
        return effect
    return replace(effect, cardiac=Wave(STILL, effect.cardiac.amplitude), respiratory=Wave(STILL, 1e-3))


def potential(fem: Fem, loads: Loads, answer: Deformation) -> float:
    """What is stored [J]: of tissue, barriers and the loads' work, of relaxing tissue as its small-strain model has it.

    Springs of moduli g_i mu beside a spring: e:e mu (1 - sum g) + sum mu g_i |e - a_i|^2, with 2 mu e = S and
    2 mu g_i (e - a_i) = H_i; all but sum mu g_i |a_i|^2 is the problem's own energy where no time passes.
    """
    now = Cases(Loads(loads.causes, answer.time), answer.time, answer.memory, answer.displacement)
    fem.problem.begin(now)
    out = wp.zeros(1, dtype=wp.float64, device="cpu")
    for term in fem.problem.terms:
        if term.name != "inertia":
            term.energy(fem.problem.device.upload(answer.displacement.reshape(-1, 1)), out)
    stored = float(out.numpy()[0])
    tissue = next(effect.default for effect in fem.effects if isinstance(effect, Elasticity))
    assert tissue is not None
    for name in (name for name in answer.memory if name.startswith("visco")):
        S, *H = np.moveaxis(answer.memory[name][0].reshape(-1, 1 + len(tissue.prony), 6), 1, 0)
        for (share, _), left in zip(tissue.prony, H, strict=True):
            square = (left - share * S) ** 2 @ [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]
            stored += float(square @ BODY.mesh.volumes) / (4.0 * share * tissue.lame[0])
    return stored


@pytest.mark.parametrize(("step", "damping"), [(1e-3, 0.0), (1e-2, 0.0), (1e-2, 5.0)])
@pytest.mark.parametrize("name", SCENES)
def test_total_energy_does_not_grow_under_constant_load(name: str, step: float, damping: float) -> None:
    body, effects, loads, answer = posed(name)
    fem = Fem(body, (*effects, Inertia(damping=damping)), TIGHT, "cpu", element="p1")
    mass, begun = compute_lumped_mass(Inertia().density, fem.space), answer.time
    kinetic, stored = [], []
    for number in range(1, STEPS + 1):
        answer = fem.deform(Loads(loads.causes, begun + number * step), answer)
        assert answer.outcome[0].good
        kinetic.append(0.5 * float((mass[:, None] * answer.memory["inertia"][0] ** 2).sum()))
        stored.append(potential(fem, loads, answer))
    total = np.add(kinetic, stored)
    span = total[0] - total[-1]
    assert np.diff(total).max() < 1e-7 * span and span > 1e-8 and max(kinetic) > 0.1 * span

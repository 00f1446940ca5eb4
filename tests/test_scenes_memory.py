"""Device memory of a scene: the exact sum of the memory of its effects."""

import gc
from types import FunctionType, ModuleType

import numpy as np
import pytest
import warp as wp
from conftest import make_box
from witness import slippery

from scenes.play.effect_ablation import list_arrays, remove_effect
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import SCENES, Scene, find_scene
from sim.compile import compile_problem
from sim.discretisation.footprint import ContactSurface
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Pulsation, Resection
from sim.loads import Resected
from sim.runtime.device import find_device

pytestmark = pytest.mark.usefixtures("ours_alone")

BODY = slippery(make_box((4, 4, 4), spacing=18e-3, tumour=16e-3, depth=30e-3, opening=26e-3))
SITE = build_craniotomy_frame(BODY)

# One scene for each set of effects: others keep the same.
DISTINCT = {frozenset(type(effect) for effect in find_scene(name).effects): name for name in SCENES}.values()
# Effects and the terms that they are; others are constraints, which stand in the same arrays.
TERMS = {
    "ToolForce": "tool force",
    "ToolContact": "tool contact",
    "Retraction": "retraction",
    "SkullContact": "skull contact",
    "Gravity": "gravity",
}


def reached(thing: object, arrays: set[int]) -> set[int]:
    """Which of some arrays, by id, an object of ours leads to: not through modules, classes and what functions see."""
    found, seen, ahead = set(), set(), [thing]
    while ahead:
        one = ahead.pop()
        if id(one) in seen or isinstance(one, ModuleType | type | wp.Kernel | wp.Module | wp.Device):
            continue
        seen.add(id(one))
        if id(one) in arrays:
            found.add(id(one))
        ahead += [*(one.__closure__ or ())] if isinstance(one, FunctionType) else gc.get_referents(one)
    return found


def kept(scene: Scene) -> dict[str, int]:
    """Bytes of the arrays that each term of the scene's problem keeps, by name, after one look at a frame."""
    effects = tuple(effect for effect in scene.get_effects_on(BODY) if not isinstance(effect, Resection))
    device, space = find_device("cpu", "float32"), discretise(BODY.mesh, scene.element)
    skin, time = ContactSurface(space.nodes, space.surface, device), 0.45 * scene.duration
    loads = scene.build_loads(SITE, scene.path(time), time).drop(Resected)
    u, out = device.allocate(3 * space.count, 1), device.allocate(3 * space.count, 1)
    flags = device.upload(np.zeros(1), wp.int32)
    before = {id(array) for array in list_arrays()}
    problem = compile_problem(effects, BODY, device, space, skin)
    problem.begin(Cases(loads, np.zeros(1)))
    problem.energy(u)
    problem.gradient(u)
    for term in problem.terms:
        term.linearise(u, flags)
    problem.add_curvature(u, out)
    problem.end(u)
    new = {id(array): array for array in list_arrays() if id(array) not in before}
    owned = {term.name: reached(term, set(new)) for term in problem.terms}
    owned["constraint"] = reached(problem.constraint, set(new))
    assert sum(map(len, owned.values())) == len(new)  # each is kept by one, and nothing else keeps any
    return {name: sum(new[one].capacity for one in numbers) for name, numbers in owned.items()}


@pytest.mark.parametrize("name", DISTINCT)
def test_removing_an_effect_frees_only_its_own_memory(name):
    scene = find_scene(name)
    whole = kept(scene)
    assert min(whole.values()) > 1_000
    for effect in scene.effects:
        if isinstance(effect, Elasticity | Held):  # a body needs them
            continue
        less, own = kept(remove_effect(scene, effect)), TERMS.get(type(effect).__name__)
        if isinstance(effect, Pulsation):  # elasticity swells
            assert all((size < whole[term]) == ("elasticity" in term) for term, size in less.items())
            continue
        assert less == {term: size for term, size in whole.items() if term != own} and (own is None or own in whole)


def test_memory_of_a_scene_is_reproducible():
    assert kept(find_scene("press")) == kept(find_scene("press"))

"""Imports, kernels, launches and memory of each scene are only those of its effects, in a fresh interpreter."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from scenes.script.scene import SCENES, find_scene
from sim.effects import BuiltIn, Elasticity
from sim.material import LAWS

TESTS = Path(__file__).parent


@dataclass(frozen=True)
class Cost:
    """What it takes to have an effect: modules of `sim.terms`, kernels of a frame, classes that keep arrays."""

    modules: frozenset[str] = frozenset()
    kernels: frozenset[str] = frozenset()
    classes: frozenset[str] = frozenset()


def cost(modules: str = "", kernels: str = "", classes: str = "") -> Cost:
    """Of words."""
    return Cost(frozenset(modules.split()), frozenset(kernels.split()), frozenset(classes.split()))


TOOLS = cost(
    "contact.barrier contact.enclosure contact.reduced contact.tool_blocks contact.tool_contact contact.tool_functions "
    "contact.tool_kernels contact.tool_path",
    "contact.enclosure:add_angle contact.tool_kernels:add_gradient contact.tool_kernels:add_reaction "
    "contact.tool_kernels:bound_clearance contact.tool_kernels:measure_depth",
    "ContactSampling ReducedToolBarrier ToolContactTerm ToolFunctions ToolKernels",
)
# A new effect adds one line.
OF_EFFECT = {
    "Elasticity": cost(
        "elasticity element_functions element_kernels laws.invariants laws.law state_source",
        "element_kernels:add_gradient",
        "ElasticTerm ElementFunctions ElementKernels Law _Part",
    ),
    "Held": cost(),
    "Bonded": cost(),
    "Slide": cost(),
    "ToolForce": cost(
        "dead_force", "dead_force:distribute dead_force:subtract_forces", "DeadForce DeadForceKernels NodalForces"
    ),
    "ToolDisplacement": cost(),
    "NodalForce": cost("dead_force", "", "DeadForce DeadForceKernels"),
    "Gravity": cost("dead_force gravity", "dead_force:subtract_forces", "DeadForce DeadForceKernels NodalForces"),
    "Inertia": cost("inertia", "inertia:add_force", "InertiaKernels InertiaTerm"),
    "Pulsation": cost("swelling", "swelling:write_ratio element_kernels:copy_coefficients", "Swelling SwellingKernels"),
    "Resection": cost(),
    "ToolContact": TOOLS,
    "Retraction": TOOLS,
    "SkullContact": cost(
        "contact.barrier contact.skull_contact contact.skull_surface",
        "contact.skull_contact:add_gradient",
        "Bone BoneSettings Skull SkullBarrier SkullKernels",
    ),
}
OF_LAW = {
    "linear": cost("laws.linear"),
    "corotational": cost("laws.corotational"),
    "neo-hookean": cost("laws.neo_hookean"),
    "stable-neo-hookean": cost("laws.stable_neo_hookean"),
    "ogden": cost("laws.ogden laws.ogden_powers laws.spectral"),
    "prony": cost(
        "laws.isochoric_split laws.neo_hookean viscoelastic",
        "element_kernels:compute_gradients element_kernels:copy_coefficients viscoelastic:update_history "
        "viscoelastic:write_relaxation",
        "LawSplit Prony ViscoelasticKernels",
    ),
}
# What a solver may do of any energy, as the load needs it.
ANY = {f"element_kernels:{name}" for name in ("add_energy", "add_curvature", "add_diagonal", "bound_step")} | {
    "dead_force:subtract_work",
    "inertia:add_energy",
    "inertia:add_blocks",
    "contact.tool_kernels:add_matrix",
    "strain_kernels:compute_tangents",
    "strain_kernels:update_max_strain",
    "strain_kernels:add_stiffening",
    *(
        f"{name}:{kernel}"
        for name in ("contact.tool_kernels", "contact.skull_contact")
        for kernel in ("add_curvature", "bound_step")
    ),
}


@pytest.fixture(scope="module")
def witnessed() -> Iterator[Callable[..., dict[str, set[str]]]]:
    """What `witness.py` says of a scene, more effects, a law and an element, each in a process of its own."""
    paths = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    words, where = [sys.executable, str(TESTS / "witness.py")], {**os.environ, "PYTHONPATH": paths}
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=where) as process:
        asked, said = process.stdin, process.stdout
        assert asked is not None and said is not None

        @cache
        def witness(scene: str, more: str = "", law: str = "", element: str = "") -> dict[str, set[str]]:
            print(json.dumps([scene, more, law, element]), file=asked, flush=True)
            found = json.loads(said.readline())
            assert found is not None, "the play failed: see what it printed"
            return {name: set(those) for name, those in found.items()}

        yield witness


def expected(effects: list[str], law: str) -> Cost:
    """Of all effects and the law."""
    costs = [*(OF_EFFECT[name] for name in effects), OF_LAW[law]]
    return Cost(*(frozenset().union(*(getattr(one, name) for one in costs)) for name in Cost.__dataclass_fields__))


def of_terms(kernels: set[str]) -> set[str]:
    """Those kernels that are terms', without what any energy may need."""
    return {name.removeprefix("sim.terms.") for name in kernels if name.startswith("sim.terms.")} - ANY


def check(found: dict[str, set[str]], effects: list[str], law: str) -> None:
    """Nothing less, and nothing more."""
    want = expected(effects, law)
    assert found["imported"] - {"strain_kernels"} == want.modules  # a solver's, of any energy
    assert found["living"] - {"StrainKernels"} == want.classes
    assert (
        of_terms(found["launched"]) >= want.kernels if law == "prony" else want.kernels == of_terms(found["launched"])
    )
    assert {name.split(":")[0] for name in of_terms(found["compiled"])} <= want.modules
    assert not found["heavy"]


def effects_of(name: str) -> list[str]:
    """The effects of a built-in scene, by name."""
    scene = find_scene(name)
    return [*(type(effect).__name__ for effect in scene.effects), *(["Resection"] if scene.surgery else [])]


def get_law_name(name: str) -> str:
    """The law of a built-in scene's tissue."""
    (tissue,) = (effect.default for effect in find_scene(name).effects if isinstance(effect, Elasticity))
    assert tissue is not None
    return "prony" if tissue.prony else tissue.law


def test_modules_are_listed_for_every_effect_and_law():
    assert set(OF_EFFECT) == {kind.__name__ for kind in BuiltIn.__args__}
    assert set(OF_LAW) == {*LAWS, "ogden", "prony"}


@pytest.mark.parametrize("scene", {(*effects_of(name), get_law_name(name)): name for name in SCENES}.values())
def test_scene_loads_only_modules_of_its_effects(witnessed, scene):
    check(witnessed(scene), effects_of(scene), get_law_name(scene))


@pytest.mark.parametrize(
    "more", ["Inertia", "Pulsation", "NodalForce", "ToolDisplacement", "ToolContact", "Retraction", "Inertia+Gravity"]
)
def test_added_effect_loads_only_its_own_modules(witnessed, more):
    check(witnessed("press", more), [*effects_of("press"), *more.split("+")], get_law_name("press"))


@pytest.mark.parametrize("law", sorted(set(OF_LAW) - {"stable-neo-hookean"}))
def test_scene_with_one_law_compiles_no_other_law(witnessed, law):
    """A linear scene compiles no Ogden kernel and does not read its source."""
    check(witnessed("press", "", law), effects_of("press"), law)


@pytest.mark.parametrize("element", ["p2", "smoothed"])
def test_element_choice_loads_no_additional_terms(witnessed, element):
    found = witnessed("press", "", "", element)
    check(found, effects_of("press"), get_law_name("press"))
    grids = {"sim.linalg.multigrid", "sim.linalg.block_sparse"}
    assert (grids <= {name.split(":")[0] for name in found["launched"]}) == (element == "p2")


def test_frame_kernels_are_precompiled(witnessed):
    """Launched kernels are a subset of the compiled ones, and a scene without tools compiles no footprint."""
    press, sinking = witnessed("press"), witnessed("brain_shift")
    assert press["launched"] <= press["compiled"] and len(press["launched"]) > 10
    assert not {name for name in sinking["compiled"] if "footprint" in name or name.endswith("dead_force:distribute")}

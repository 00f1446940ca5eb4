"""Derivatives of equilibria against central differences, for laws, elements and effects; what has no derivative."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from boxes import base_held, box, hold, top_forces

from sim.accuracy import REFERENCE, TRAIN
from sim.adjoint.equilibrium_gradient import compute_jacobian, differentiate_equilibrium
from sim.adjoint.tissue_gradient import list_parameters
from sim.anatomy import Anatomy
from sim.effects import (
    Effect,
    Elasticity,
    Gravity,
    Held,
    Inertia,
    NodalForce,
    Pulsation,
    ToolContact,
    ToolDisplacement,
    ToolForce,
)
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Cause, Displaced, Loads, Nodal, Posture, Prescribed, Pushed, Touching
from sim.material import MEASURED_BRAIN, IsotropicTissue, Material, Ogden
from sim.skulls import Slide
from sim.tools import Ball

EXACT = replace(REFERENCE, tolerance=1e-11)
ELEMENTS = "p1", "smoothed", "p2"
LAWS = {
    **{law: Material(law, 3000.0, 0.45) for law in ("linear", "corotational", "neo-hookean", "stable-neo-hookean")},
    "ogden": Ogden(((1500.0, -7.0), (700.0, 2.0)), 5e4),
    "brain": MEASURED_BRAIN,
}
BOX = box((2, 2, 2), 0.05, 0.2)
MESH = TetMesh(BOX.nodes, BOX.tets, (np.arange(len(BOX.tets)) // 6 > 5).astype(int))
LOW = MESH.nodes[:, 2] < 1e-9
SIDE = (MESH.nodes[:, 0] < 1e-9) & ~LOW
HELD = base_held(MESH)
SLIDING = hold(MESH, LOW, np.where(SIDE[:, None], [-1.0, 0.0, 0.0], 0.0))
NEO = LAWS["neo-hookean"]
STIFF = NEO.replace_constants(9000.0)
PUSH = Pushed(np.array([[0.025, 0.025, 0.05], [0.03, 0.02, 0.05]]), np.array([[0.02, 0.0, -0.1], [0.0, 0.03, -0.12]]),
              np.array([0.01, 0.012]))  # fmt: skip
POSTURE = Posture(np.array([[0.3, 0.5, -1.0]]), np.array([0.021]), np.ones(1))
POSE = np.eye(4)[None, None] + np.pad([[0.024], [0.027], [0.046]], ((0, 1), (3, 0)))
MOVED = np.zeros((1, len(MESH.nodes), 3))
MOVED[0, LOW] = 5e-4 * np.random.default_rng(0).standard_normal((LOW.sum(), 3))


@dataclass(frozen=True)
class Case:
    """Effects with given tissue on an anatomy, loads, and the components to differentiate, with steps."""

    anatomy: Anatomy
    effects: tuple[Effect, ...]
    causes: tuple[Cause, ...]
    checked: tuple[tuple[int, str, tuple[int, ...], float], ...]


NODE = int(np.flatnonzero(LOW)[4])
TOP = int(MESH.nodes[:, 2].argmax())
CASES = {
    "tool force": Case(SLIDING, (Slide(), ToolForce()), (PUSH,), ((0, "force", (2,), 1e-4),)),
    "nodal force": Case(HELD, (NodalForce(),), (Nodal(top_forces(MESH, np.array([[0.05, 0.0, -0.1]]))),),
                        ((0, "force", (TOP, 1), 1e-4),)),
    "gravity": Case(SLIDING, (Slide(), Gravity()), (POSTURE,),
                    ((0, "direction", (0,), 1e-4), (0, "csf_level", (), 1e-5), (0, "share", (), 1e-3))),
    "prescribed": Case(SLIDING, (Slide(),), (Prescribed(MOVED),), ((0, "displacement", (NODE, 2), 1e-5),)),
    "tool displacement": Case(HELD, (ToolDisplacement(),), (Displaced(PUSH.point, 0.03 * PUSH.force, PUSH.footprint),),
                              ((0, "displacement", (2,), 1e-5),)),
    "swelling": Case(HELD, (Pulsation(), ToolForce()), (PUSH,), ((0, "force", (0,), 1e-4),)),
    "contact": Case(SLIDING, (Slide(), ToolContact((Ball(8e-3),)), Gravity()), (Touching(POSE), POSTURE),
                    ((0, "pose", (0, 2), 1e-7), (1, "share", (), 1e-4))),
}  # fmt: skip


def build(case: Case, tissue: IsotropicTissue, tumour: IsotropicTissue, element: str) -> Fem:
    return Fem(case.anatomy, (Elasticity(tissue, {1: tumour}), Held(), *case.effects), EXACT, "cpu", element=element)


def build_seed(count: int) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((count, len(MESH.nodes), 3))


def difference(evaluate: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """Central difference of a function of the step."""
    return (evaluate(step) - evaluate(-step)) / (2.0 * step)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", LAWS)
def test_tissue_derivatives_equal_central_differences(law: str, element: str) -> None:
    """Along a random direction in the space of all parameters of both regions."""
    case, tissue = CASES["tool force"], LAWS[law]
    both = tissue, tissue.replace_constants(2.0 * tissue.young)
    fem, loads, seed = build(case, *both, element), Loads(case.causes), build_seed(2)
    found = differentiate_equilibrium(fem, loads, fem.deform(loads), seed).regions
    listed = [list_parameters(one) for one in both]
    assert [set(found[label]) for label in (0, 1)] == [set(one) for one in listed]
    random = np.random.default_rng(2)
    # Poisson's ratio is near its limit: its relative steps are a tenth of the others.
    way = [{name: random.uniform(0.5, 1.5) * (0.1 if name == "poisson" else 1.0) for name in one} for one in listed]

    def evaluate(step: float) -> np.ndarray:
        changed = list(both)
        for label, (own, rates) in enumerate(zip(listed, way, strict=True)):
            for name, rate in rates.items():
                value = list_parameters(changed[label])[name][0]
                changed[label] = own[name][1](changed[label], value * (1.0 + step * rate))
        return (build(case, changed[0], changed[1], element).deform(loads).displacement * seed).sum(axis=(1, 2))

    own = [
        found[label][name] * rate * listed[label][name][0]
        for label, rates in enumerate(way)
        for name, rate in rates.items()
    ]
    expected = difference(evaluate, 1e-4)
    np.testing.assert_allclose(np.sum(own, axis=0), expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("name", CASES)
def test_load_and_tissue_derivatives_equal_differences(name: str, element: str) -> None:
    case, loads = CASES[name], Loads(CASES[name].causes)
    fem, seed = build(case, NEO, STIFF, element), build_seed(len(loads))
    found = differentiate_equilibrium(fem, loads, fem.deform(loads), seed)

    def evaluate_tissue(step: float) -> np.ndarray:
        solver = build(case, NEO.replace_constants(NEO.young + step), STIFF, element)
        return (solver.deform(loads).displacement * seed).sum(axis=(1, 2))

    expected = difference(evaluate_tissue, 1e-4 * NEO.young)
    scale = np.abs(found.regions[1]["young"] * STIFF.young / NEO.young).max()
    np.testing.assert_allclose(found.regions[0]["young"], expected, rtol=1e-6, atol=1e-6 * scale)
    for number, array, index, step in case.checked:

        def evaluate(size: float, number=number, array=array, index=index) -> np.ndarray:
            value = getattr(case.causes[number], array).copy()
            value[(slice(None), *index) if array != "pose" else (slice(None), 0, index[1], 3)] += size
            changed = replace(case.causes[number], **{array: value})
            causes = [changed if k == number else one for k, one in enumerate(case.causes)]
            return (fem.deform(Loads(tuple(causes))).displacement * seed).sum(axis=(1, 2))

        expected = difference(evaluate, step)
        own = found.causes[number][array][(slice(None), *index)]
        np.testing.assert_allclose(own, expected, rtol=3e-6, atol=1e-6 * np.abs(expected).max(), err_msg=array)


def test_footprint_derivatives_equal_coarse_differences() -> None:
    """Small differences show the sum over triangles instead of the integral; steps of 5 % of the radius do not."""
    case = CASES["tool force"]
    fem, seed = build(case, NEO, STIFF, "p1"), build_seed(2)
    found = differentiate_equilibrium(fem, Loads(case.causes), fem.deform(Loads(case.causes)), seed).causes[0]
    for name, change in (("point", [5e-4, 0.0, 0.0]), ("footprint", 5e-4)):

        def evaluate(sign: float, name=name, change=change) -> np.ndarray:
            loads = Loads((replace(PUSH, **{name: getattr(PUSH, name) + sign * np.array(change)}),))
            return (fem.deform(loads).displacement * seed).sum(axis=(1, 2))

        own = found[name] if name == "footprint" else found[name][:, 0]
        np.testing.assert_allclose(own, difference(evaluate, 1.0) / 5e-4, rtol=0.1)


@pytest.mark.parametrize("started", [False, True])
def test_relaxing_tissue_is_differentiated_for_one_step(started: bool) -> None:
    """From the undeformed state, or from an earlier solution whose history is kept."""
    tissue = replace(NEO, prony=((0.45, 0.5),))
    fem, seed = build(CASES["tool force"], tissue, tissue, "smoothed"), build_seed(2)
    first = fem.deform(Loads((replace(PUSH, force=0.4 * PUSH.force),), np.full(2, 0.1))) if started else None
    loads = Loads((PUSH,), np.full(2, 0.4))
    found = differentiate_equilibrium(fem, loads, fem.deform(loads, start=first), seed, start=first)

    def evaluate(step: float) -> np.ndarray:
        changed = replace(tissue, young=tissue.young + step)
        solver = build(CASES["tool force"], changed, changed, "smoothed")
        return (solver.deform(loads, start=first).displacement * seed).sum(axis=(1, 2))

    own = found.regions[0]["young"] + found.regions[1]["young"]
    np.testing.assert_allclose(own, difference(evaluate, 3.0), rtol=1e-6)


@pytest.mark.parametrize("element", ELEMENTS)
def test_derivatives_of_tetrahedra_sum_to_that_of_region(element: str) -> None:
    case = CASES["tool force"]
    fem = build(case, MEASURED_BRAIN, STIFF, element)
    found = differentiate_equilibrium(fem, Loads(case.causes), fem.deform(Loads(case.causes)), build_seed(2))
    each = found.compute_by_tetrahedron("young")
    for label in (0, 1):
        np.testing.assert_allclose(each[:, MESH.region == label].sum(axis=1), found.regions[label]["young"], rtol=1e-9)
    assert (found.compute_by_tetrahedron("m1")[:, MESH.region == 1] == 0.0).all()  # only Ogden's law has exponents
    with pytest.raises(InputError, match="no tissue has a parameter 'mass'"):
        found.compute_by_tetrahedron("mass")


def test_derivative_of_one_tetrahedron_equals_difference() -> None:
    """The tetrahedron becomes a region of its own."""
    case, number = CASES["tool force"], 20
    fem, seed = build(case, NEO, STIFF, "p1"), build_seed(2)
    found = differentiate_equilibrium(fem, Loads(case.causes), fem.deform(Loads(case.causes)), seed)
    region = MESH.region.copy()
    region[number] = 7
    anatomy = replace(case.anatomy, mesh=TetMesh(MESH.nodes, MESH.tets, region))
    own = (NEO, STIFF)[MESH.region[number]]

    def evaluate(step: float) -> np.ndarray:
        elasticity = Elasticity(NEO, {1: STIFF, 7: own.replace_constants(own.young + step)})
        solver = Fem(anatomy, (elasticity, Held(), *case.effects), EXACT, "cpu", element="p1")
        return (solver.deform(Loads(case.causes)).displacement * seed).sum(axis=(1, 2))

    expected = difference(evaluate, 10.0)
    np.testing.assert_allclose(found.compute_by_tetrahedron("young")[:, number], expected, rtol=1e-5)


def test_single_precision_agrees_with_double() -> None:
    case, loads, seed = CASES["tool force"], Loads(CASES["tool force"].causes), build_seed(2)
    found = []
    for accuracy in (EXACT, replace(TRAIN, tolerance=2e-5)):
        effects = (Elasticity(NEO, {1: STIFF}), Held(), *case.effects)
        fem = Fem(case.anatomy, effects, accuracy, "cpu", element="smoothed")
        found.append(differentiate_equilibrium(fem, loads, fem.deform(loads), seed))
    np.testing.assert_allclose(found[1].regions[0]["young"], found[0].regions[0]["young"], rtol=2e-3)
    np.testing.assert_allclose(found[1].causes[0]["force"], found[0].causes[0]["force"], rtol=2e-3, atol=1e-2)


def test_what_has_no_derivative_is_rejected_in_one_message() -> None:
    case, loads, seed = CASES["tool force"], Loads(CASES["tool force"].causes), build_seed(2)
    fem = build(case, NEO, STIFF, "p1")
    found = fem.deform(loads)
    with pytest.raises(InputError, match=r"seed has shape \(2, 3\)"):
        differentiate_equilibrium(fem, loads, found, np.zeros((2, 3)))
    failed = replace(found, outcome=(found.outcome[0], type(found.outcome[0]).BUDGET))
    with pytest.raises(InputError, match="load 1 is not converged"):
        differentiate_equilibrium(fem, loads, failed, seed)
    moving = Fem(case.anatomy, (Elasticity(NEO), Held(), Inertia(), ToolForce()), EXACT, "cpu", element="p1")
    with pytest.raises(InputError, match="remove Inertia"):
        differentiate_equilibrium(moving, loads, found, seed)
    springs = Fem(
        HELD, (Elasticity(Material("linear", 3000.0, 0.25)), Held(), ToolForce()), EXACT, "cpu", element="springs"
    )
    with pytest.raises(InputError, match="choose p1, smoothed or p2"):
        differentiate_equilibrium(springs, loads, found, seed)
    with pytest.raises(InputError, match="SimpleNamespace has no derivatives: give a Fem"):
        differentiate_equilibrium(SimpleNamespace(), loads, found, seed)  # pyright: ignore[reportArgumentType]
    touching = Fem(HELD, (Elasticity(NEO), Held(), ToolContact((Ball(8e-3),))), TRAIN, "cpu", element="p1")
    pressed = Loads((Touching(POSE),))
    with pytest.raises(InputError, match="pose of a tool require float64"):
        differentiate_equilibrium(touching, pressed, touching.deform(pressed), build_seed(1))


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("name", ["tool force", "prescribed", "contact"])
def test_forward_mode_agrees_with_adjoint(name: str, element: str) -> None:
    case, loads = CASES[name], Loads(CASES[name].causes)
    fem, seed = build(case, MEASURED_BRAIN, STIFF, element), build_seed(len(loads))
    answer = fem.deform(loads)
    parameters = [(0, "young"), (0, "poisson"), (0, "m1"), (1, "young")]
    arrays = {"tool force": [(0, "force"), (0, "footprint")], "prescribed": [], "contact": [(0, "pose"), (1, "share")]}[
        name
    ]
    found = (compute_jacobian(fem, loads, answer, parameters, arrays) * seed).sum(axis=(2, 3))
    adjoint = differentiate_equilibrium(fem, loads, answer, seed)
    expected, rows = adjoint.regions, [adjoint.causes[number][array] for number, array in arrays]
    if rows:
        row = np.concatenate([row.reshape(len(loads), -1) for row in rows], axis=1).T
        np.testing.assert_allclose(found[len(parameters) :], row, rtol=1e-6, atol=1e-6 * np.abs(row).max())
    for number, (label, parameter) in enumerate(parameters):
        np.testing.assert_allclose(found[number], expected[label][parameter], rtol=1e-6)
    with pytest.raises(InputError, match="region 3 has no parameter 'young'"):
        compute_jacobian(fem, loads, answer, [(3, "young")])
    with pytest.raises(InputError, match="cause 5 has no array 'force'"):
        compute_jacobian(fem, loads, answer, arrays=[(5, "force")])

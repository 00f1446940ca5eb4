"""Tissue that relaxes: the curves of a Prony series, constant volume, rotations, and history carried with results."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, hold, top_forces
from oracle import tissue

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce, ToolForce
from sim.elements import ELEMENTS
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal, push
from sim.material import HYPERELASTIC, Material, Ogden, Tissue
from sim.runtime.device import find_device

SERIES = ((0.45, 0.5), (0.365, 5.0))
MESH = box((1, 1, 1), 0.1)
TIGHT = Accuracy(tolerance=1e-11)
TINY = 1e-6
SHEAR = TINY * np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
STRETCH = TINY * np.diag([1.0, 0.0, 0.0])


def relaxing(law: str, series: tuple[tuple[float, float], ...] = SERIES) -> Tissue:
    return replace(tissue(law), prony=series)


def modulus(time: np.ndarray | float) -> np.ndarray:
    """What is left of the shear modulus, as a share of what it was at once."""
    return 1.0 - sum(g * (1.0 - np.exp(-np.asarray(time) / tau)) for g, tau in SERIES)


def posed(made_of: Tissue, element: str = "p1", mesh: TetMesh = MESH) -> tuple[Problem, np.ndarray]:
    """A box without anything that acts on it, and its nodes (N, 3) [m]."""
    space = discretise(mesh, element)
    effects = (Elasticity(made_of), Held())
    return compile_problem(effects, base_held(mesh), find_device("cpu", "float64"), space), space.nodes


def stresses(problem: Problem, nodes: np.ndarray, path: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mean first Piola-Kirchhoff stress (n, 3, 3) [Pa] along displacement gradients (n, 3, 3), the same everywhere."""
    found, memory, before = [], {}, 0.0
    for H, time in zip(path, times, strict=True):
        u = problem.device.upload((nodes @ H.T).reshape(-1, 1))
        problem.begin(Cases(Loads((), np.array([time])), np.array([before]), memory))
        found.append(problem.gradient(u).numpy().reshape(-1, 3).T @ nodes / MESH.volumes.sum())
        memory, before = problem.end(u), time
    return np.array(found)


@pytest.mark.parametrize("law", HYPERELASTIC)
def test_constant_strain_relaxes_by_series_except_volume(law: str) -> None:
    """Exactly at every step of any length: a constant strain is convolved with a step function."""
    problem, nodes = posed(relaxing(law))
    times = np.array([0.0, 0.01, 0.3, 1.0, 4.0, 50.0])
    mu, lam = tissue(law).lame
    for strain in (SHEAR, STRETCH, TINY * np.eye(3)):
        found = stresses(problem, nodes, np.repeat(strain[None], len(times), axis=0), times)
        mean = np.trace(strain) / 3.0 * np.eye(3)
        expected = 2.0 * mu * modulus(times)[:, None, None] * (strain - mean) + (3.0 * lam + 2.0 * mu) * mean
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("strain", [SHEAR, STRETCH - np.trace(STRETCH) / 3.0 * np.eye(3)])
def test_linear_strain_error_is_of_second_order_in_the_step(strain: np.ndarray) -> None:
    """Strain that grows with t: sigma = 2 mu (t - sum g (t - tau (1 - exp(-t / tau))))."""
    problem, nodes = posed(relaxing("neo-hookean"))
    left = 1.0 - sum(g * (1.0 - tau * (1.0 - np.exp(-1.0 / tau))) for g, tau in SERIES)
    exact = 2.0 * tissue("neo-hookean").lame[0] * left * strain
    errors = []
    for count in (4, 8, 16):
        times = np.linspace(0.0, 1.0, count + 1)[1:]
        found = stresses(problem, nodes, times[:, None, None] * strain, times)[-1]
        errors.append(np.linalg.norm(found - exact) / np.linalg.norm(exact))
    assert errors[-1] < 2e-3
    assert np.log2(errors[0] / errors[1]) > 1.9
    assert np.log2(errors[1] / errors[2]) > 1.9


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", HYPERELASTIC)
def test_relaxing_tissue_at_time_zero_agrees_with_its_law(law: str, element: str) -> None:
    """At finite strain: forces and curvature."""
    mesh = box((1, 1, 2), 0.1)
    (plain, nodes), (viscous, _) = posed(tissue(law), element, mesh), posed(relaxing(law), element, mesh)
    u, p = np.random.default_rng(1).normal(size=(2, nodes.size, 1))
    found = []
    for problem in (plain, viscous):
        at = problem.device.upload(2e-3 * u)
        problem.begin(Cases(Loads((), np.zeros(1)), np.zeros(1)))
        problem.linearise(at, np.zeros(1, bool))
        bent = problem.device.allocate(*u.shape)
        problem.add_curvature(problem.device.upload(p), bent)
        found.append((problem.gradient(at).numpy(), bent.numpy()))
    assert plain.can_accelerate and not viscous.can_accelerate
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(one).max())


@pytest.mark.parametrize("law", HYPERELASTIC)
def test_rotated_history_rotates_the_stress(law: str) -> None:
    """With a rotation of the body from the start or in between."""
    problem, nodes = posed(relaxing(law))
    rng, times = np.random.default_rng(2), np.array([0.2, 0.5, 1.1, 3.0])
    path = 0.2 * rng.normal(size=(4, 3, 3))
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    Q *= np.linalg.det(Q)
    still = stresses(problem, nodes, path, times)
    for first in (0, 2):
        turned = np.where(np.arange(4)[:, None, None] >= first, Q @ (np.eye(3) + path) - np.eye(3), path)
        found = stresses(problem, nodes, turned, times)
        np.testing.assert_allclose(found[first:], Q @ still[first:], atol=1e-9 * np.abs(still).max())
    fresh = stresses(problem, nodes, path[-1:], times[-1:])
    assert np.abs(fresh[-1] - still[-1]).max() > 0.01 * np.abs(still[-1]).max()


@pytest.mark.parametrize("element", ELEMENTS)
def test_pulled_block_creeps_to_its_long_term_stiffness(element: str) -> None:
    mesh = box((1, 1, 2), 0.1)
    anatomy, effects = base_held(mesh), (Held(), NodalForce())
    pull = (Nodal(top_forces(mesh, np.array([2e-4, 0.0, 2e-4]))),)
    mu, lam = Material("neo-hookean", 3000.0, 0.45).lame
    left = float(modulus(np.inf))
    bulk = lam + 2.0 * mu / 3.0
    soft = Material(
        "neo-hookean",
        9.0 * bulk * left * mu / (3.0 * bulk + left * mu),
        (3.0 * bulk - 2.0 * left * mu) / (6.0 * bulk + 2.0 * left * mu),
    )
    ends = [
        Fem(anatomy, [Elasticity(Material("neo-hookean", 3000.0, 0.45)), *effects], TIGHT, "cpu", element=element),
        Fem(anatomy, [Elasticity(soft), *effects], TIGHT, "cpu", element=element),
    ]
    first, last = (fem.deform(Loads(pull)).displacement for fem in ends)
    fem = Fem(anatomy, [Elasticity(relaxing("neo-hookean")), *effects], TIGHT, "cpu", element=element)
    answer, track = None, []
    for time in [0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 100.0, 200.0]:
        answer = fem.deform(Loads(pull, np.array([time])), answer)
        assert answer.outcome[0].good
        track.append(answer.displacement[0, -1, 0])
    assert answer is not None
    if element != "smoothed":  # which parts stiffness by Lame's constants, and lends volume what shape has left
        np.testing.assert_allclose(answer.displacement, last, atol=2e-3 * np.abs(last).max())
    assert track[0] == pytest.approx(first[0, -1, 0], rel=1e-6)
    assert (np.diff(track) > -1e-9 * track[-1]).all() and track[-1] > 2.0 * track[0]


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_time_step_of_a_day_reaches_long_term_stiffness(precision: str) -> None:
    """The result is near the long-term stiffness, and no number overflows."""
    pull = (Nodal(top_forces(MESH, np.array([1e-4, 0.0, 0.0]))),)
    accuracy = replace(TIGHT, tolerance=1e-4, precision=precision)
    fem = Fem(
        base_held(MESH), [Elasticity(relaxing("neo-hookean")), Held(), NodalForce()], accuracy, "cpu", element="p1"
    )
    rest = fem.deform(Loads(pull))
    once = fem.deform(Loads(pull, np.array([86400.0])), rest)
    again = fem.deform(Loads(pull, np.array([2.0 * 86400.0])), once)
    assert once.outcome[0].good and again.outcome[0].good
    left = np.abs(again.displacement).max() / np.abs(rest.displacement).max()
    assert left == pytest.approx(1.0 / modulus(np.inf), rel=0.2)


def test_second_solver_continues_relaxation_exactly() -> None:
    """Another solver continues as from the start; regions that do not relax have no memory."""
    halves = TetMesh(MESH.nodes, MESH.tets, np.arange(len(MESH.tets)) % 2)
    anatomy, force = base_held(halves), Nodal(top_forces(halves, np.array([[0.5, 0.0, 0.2], [0.0, 0.3, -0.2]])))
    law = Ogden(((900.0, -4.7),), 2e4)
    tissues = Elasticity(law, {1: replace(law, prony=SERIES)})

    def run(fem: Fem, start: object, times: tuple[float, ...]) -> object:
        for time in times:
            start = fem.deform(Loads((force,), np.array([time, 2.0 * time])), start)  # pyright: ignore
        return start

    one, other = (Fem(anatomy, [tissues, Held(), NodalForce()], TIGHT, "cpu", element="p1") for _ in range(2))
    straight = run(one, None, (0.0, 0.1, 0.4, 2.0))
    begun = run(one, None, (0.0, 0.1))
    run(other, None, (0.7,))
    cut = run(other, begun, (0.4, 2.0))
    np.testing.assert_array_equal(cut.displacement, straight.displacement)  # pyright: ignore
    name = "viscoelasticity ogden"
    assert straight.memory[name].shape == (2, 3, 18)  # pyright: ignore
    np.testing.assert_array_equal(cut.memory[name], straight.memory[name])  # pyright: ignore
    assert [term.name for term in one.problem.terms] == ["elasticity ogden", name, "nodal force"]


def test_fully_held_relaxing_body_needs_no_solver() -> None:
    """A series of one pair in a body that cannot move: no forces, and a history of zeros."""
    anatomy = hold(MESH, np.ones(len(MESH.nodes), bool))
    fem = Fem(anatomy, [Elasticity(relaxing("ogden", SERIES[:1])), Held()], TIGHT, "cpu", element="p1")
    answer = fem.deform(Loads((), np.array([3.0])))
    assert not answer.displacement.any()
    assert not answer.memory["viscoelasticity ogden"].any()


@pytest.mark.parametrize("law", HYPERELASTIC)
def test_crushed_tissue_pushes_back_at_any_relaxation_time(law: str) -> None:
    """To a fifth of its height between walls, at a Poisson's ratio with little resistance of volume."""
    soft = replace(tissue(law, 3000.0, 0.3), prony=SERIES)
    problem, nodes = posed(soft)
    times = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
    height = np.array([0.0, 0.4, 0.6, 0.8, 0.8, 0.8, 0.8, 0.8])
    path = -height[:, None, None] * np.diag([0.0, 0.0, 1.0])
    found = stresses(problem, nodes, path, times)[:, 2, 2]
    assert (found[1:] < -100.0).all()


def softened(left: float, poisson: float = 0.45) -> Material:
    """Stable neo-Hookean tissue of 3 kPa with a share of its shear modulus, and its bulk modulus as it was."""
    mu, lam = Material("stable-neo-hookean", 3000.0, poisson).lame
    bulk = lam + 2.0 * mu / 3.0
    young = 9.0 * bulk * left * mu / (3.0 * bulk + left * mu)
    return Material("stable-neo-hookean", young, (3.0 * bulk - 2.0 * left * mu) / (6.0 * bulk + 2.0 * left * mu))


def test_stable_law_at_large_strain_only_softens() -> None:
    """At every moment, sheared, compressed and inverted."""
    soft = replace(softened(1.0), prony=SERIES)
    path = np.array([[[0.2, 0.5, 0.0], [-0.1, -0.3, 0.2], [0.0, 0.1, 0.4]], np.diag([-0.7, 0.5, -0.6])])
    path = np.concatenate([path, np.diag([0.1, -1.3, 0.2])[None]])
    times = np.array([0.0, 0.02, 0.5, 3.0, 40.0])
    for H in path:
        problem, nodes = posed(soft)
        found = stresses(problem, nodes, np.repeat(H[None], len(times), axis=0), times)
        for one, left in zip(found, modulus(times), strict=True):
            still, _ = posed(softened(float(left)))
            expected = stresses(still, nodes, H[None], np.zeros(1))[0]
            np.testing.assert_allclose(one, expected, atol=1e-9 * np.abs(found).max())


@pytest.mark.parametrize(("force", "element"), [(0.3, "p1"), (0.8, "p1"), (0.3, "p2")])
def test_relaxed_stable_law_agrees_with_its_elastic_limit(force: float, element: str) -> None:
    """A push to half the depth of the block, held until the relaxation has ended."""
    anatomy, effects = base_held(box((4, 4, 3), 0.05)), (Held(), ToolForce())
    pushed = push(np.array([0.026, 0.024, 0.0375]), np.array([0.01, 0.0, -force]), 7e-3)
    tight = Accuracy(tolerance=1e-8, limit_strain=False)
    elastic = Fem(anatomy, [Elasticity(softened(float(modulus(np.inf)))), *effects], tight, "cpu", element=element)
    fem = Fem(anatomy, [Elasticity(replace(softened(1.0), prony=SERIES)), *effects], tight, "cpu", element=element)
    answer = None
    for time in (0.1, 0.5, 2.0, 8.0, 1000.0):
        answer = fem.deform(replace(pushed, time=np.array([time])), answer)
        assert answer.outcome[0].good
    assert answer is not None
    still = elastic.deform(pushed).displacement
    np.testing.assert_allclose(answer.displacement, still, atol=1e-5 * np.abs(still).max())


def test_relaxing_tissue_converges_under_an_inverting_push() -> None:
    """The default law by its other name: it has the equilibria of its elastic limit, including inverted ones."""
    anatomy = base_held(box((5, 5, 3), 0.05))
    fem = Fem(
        anatomy,
        [Elasticity(replace(softened(1.0), prony=SERIES)), Held(), ToolForce()],
        Accuracy(limit_strain=False),
        "cpu",
        element="p1",
    )
    pushed = push(np.array([0.026, 0.024, 0.03]), np.array([0.01, 0.0, -1.3]), 7e-3)
    answer = None
    for time in (0.5, 1.0, 10.0, 50.0, 1000.0):
        answer = fem.deform(replace(pushed, time=np.array([time])), answer)
        assert answer.outcome[0].good

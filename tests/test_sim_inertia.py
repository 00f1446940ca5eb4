"""Inertia: periods, decay, order, energy that never increases, and state carried with the results."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic, top_forces
from scipy.linalg import eigh

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.deformation import Deformation, build_start
from sim.discretisation.problem import Problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Inertia, NodalForce, ToolContact
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal, Touching
from sim.material import Material
from sim.runtime.device import find_device
from sim.terms.inertia import compute_lumped_mass
from sim.tools import Ball, compute_distances

TIGHT = Accuracy(tolerance=1e-10)
DENSITY, YOUNG, LENGTH = 1040.0, 3000.0, 0.1
BLOCK = base_held(box((2, 2, 2), LENGTH))


def at(*times: float) -> Loads:
    """Nothing acts; (B,) times [s]."""
    return Loads((), np.array(times))


def after(fem: Fem, start: Deformation | None, steps: int, step: float, force: np.ndarray | None = None) -> Deformation:
    """So many steps [s] on, under nodal forces (1, V, 3) [N] that stay."""
    causes = () if force is None else (Nodal(force),)
    for _ in range(steps):
        start = fem.deform(Loads(causes, np.array([step if start is None else start.time[0] + step])), start)
        assert start.outcome[0].good
    assert start is not None
    return start


def rod(cells: int) -> Anatomy:
    """Held at x = 0, and across everywhere: it swings along itself."""
    mesh = box((cells, 1, 1), LENGTH)
    held = np.repeat([[False, True, True]], len(mesh.nodes), axis=0)
    held[mesh.nodes[:, 0] < 1e-9] = True
    return hold(mesh, held)


@pytest.mark.parametrize(("element", "cells"), [("p1", 8), ("smoothed", 8), ("p2", 3)])
def test_rod_oscillates_with_its_analytic_period(element: str, cells: int) -> None:
    """T = 4 L sqrt(rho / E) without contraction across; its end passes through zero after T/4 and 3/4 T."""
    period, anatomy = 4.0 * LENGTH * np.sqrt(DENSITY / YOUNG), rod(cells)
    effects = [Elasticity(Material("linear", YOUNG, 0.0)), Held(), Inertia(DENSITY)]
    fem = Fem(anatomy, effects, TIGHT, "cpu", element=element)
    x = anatomy.mesh.nodes[:, 0]
    end, step = x > LENGTH - 1e-9, period / 160
    answer = build_start(1e-4 * np.sin(np.pi * x / 2.0 / LENGTH)[None, :, None] * [1.0, 0.0, 0.0])
    track = [1e-4]
    for _ in range(130):
        answer = after(fem, answer, 1, step)
        track.append(answer.displacement[0, end, 0].mean())
    track = np.array(track)
    before = np.flatnonzero(track[:-1] * track[1:] < 0.0)
    crossed = (before + track[before] / (track[before] - track[before + 1])) * step
    assert np.diff(crossed)[0] == pytest.approx(period / 2.0, rel=0.02)


def mode(problem: Problem, mass: np.ndarray) -> tuple[float, np.ndarray]:
    """The lowest circular frequency [1/s], and its motion (N, 3), at most 0.1 mm."""
    free = np.flatnonzero(~problem.constraint.fixed.ravel())
    stiffness = problem.rest_curvature().toarray()[np.ix_(free, free)]
    squares, shapes = eigh(stiffness, np.diag(np.repeat(mass, 3)[free]))
    motion = np.zeros(problem.rows)
    motion[free] = 1e-4 * shapes[:, 0] / np.abs(shapes[:, 0]).max()
    return float(np.sqrt(squares[0])), motion.reshape(-1, 3)


@pytest.mark.parametrize("damping", [0.0, 7.0])
def test_mode_decays_as_backward_euler_predicts(damping: float) -> None:
    """Backward Euler of q'' + c q' + w^2 q = 0, for steps of very different lengths in one batch."""
    effects = [Elasticity(Material("linear", YOUNG, 0.3)), Held(), Inertia(DENSITY, damping)]
    fem = Fem(BLOCK, effects, TIGHT, "cpu", batch=2, element="p1")
    frequency, motion = mode(fem.problem, compute_lumped_mass(DENSITY, fem.space))
    steps = np.array([1e-4, 0.01, 1.1e-4, 1.0, 0.012])
    answer = build_start(np.repeat(motion[None], len(steps), axis=0))
    q, speed = np.ones(len(steps)), np.zeros(len(steps))
    for number in range(1, 5):
        answer = fem.deform(at(*(number * steps)), answer)
        speed = (speed - steps * frequency**2 * q) / (1.0 + damping * steps + (steps * frequency) ** 2)
        q = q + steps * speed
        np.testing.assert_allclose(answer.displacement, q[:, None, None] * motion, rtol=1e-6, atol=1e-12)


def test_damped_free_flight_decays_exponentially() -> None:
    """Fast compared with any stiffness, velocity decays with exp(-c t), at first order in the step."""
    soft = Elasticity(Material("linear", 0.1, 0.0))
    fem = Fem(BLOCK, [soft, Held(), Inertia(DENSITY, 5.0)], replace(TIGHT, limit_strain=False), "cpu", element="p1")
    errors = []
    for steps in (10, 20):
        velocity = np.where(BLOCK.fixed, 0.0, 1.0)[None]
        answer = build_start(np.zeros_like(velocity))
        object.__setattr__(answer, "memory", {"inertia": velocity})
        answer = after(fem, answer, steps, 0.2 / steps)
        errors.append(answer.memory["inertia"][0, -1, 0] - np.exp(-1.0))
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.1)


def plucked(poisson: float = 0.45) -> tuple[Fem, Deformation]:
    """A block that swings, and how it stands, 15 % aside, as it is let go."""
    effects = [Elasticity(Material("neo-hookean", YOUNG, poisson)), Held(), NodalForce()]
    pull = Loads((Nodal(top_forces(BLOCK.mesh, np.array([1.0, 0.0, 0.5]))),))
    aside = Fem(BLOCK, effects, TIGHT, "cpu", element="p1").deform(pull)
    assert 0.01 < np.abs(aside.displacement).max() < 0.05
    return Fem(BLOCK, [*effects, Inertia(DENSITY)], TIGHT, "cpu", element="p1"), build_start(aside.displacement)


def test_inertia_is_first_order_in_the_time_step() -> None:
    fem, start = plucked()
    one, two, four = (after(fem, start, count, 0.04 / count).displacement for count in (8, 16, 32))
    ratio = np.linalg.norm(one - two) / np.linalg.norm(two - four)
    assert 1.6 < ratio < 2.4


@pytest.mark.parametrize("poisson", [0.45, 0.49])
@pytest.mark.parametrize("step", [1e-4, 1e-2, 1.0])
def test_energy_never_increases_under_constant_load(step: float, poisson: float) -> None:
    fem, answer = plucked(poisson)
    force = top_forces(BLOCK.mesh, np.array([-0.3, 0.2, 0.1]))
    effects = [Elasticity(Material("neo-hookean", YOUNG, poisson)), Held(), NodalForce()]
    still = compile_problem(effects, BLOCK, fem.problem.device)
    still.begin(Cases(Loads((Nodal(force),)), np.zeros(1)))
    mass = compute_lumped_mass(DENSITY, fem.space)

    def total(answer: Deformation) -> float:
        velocity = answer.memory.get("inertia", np.zeros((1, 1, 3)))[0]
        potential = still.energy(still.device.upload(answer.displacement.reshape(-1, 1)))[0]
        return float(potential + 0.5 * (mass[:, None] * velocity**2).sum())

    energies = [total(answer)]
    for _ in range(25):
        answer = after(fem, answer, 1, step, force)
        energies.append(total(answer))
    span = max(energies) - min(energies)
    assert np.diff(energies).max() <= 1e-7 * span
    assert energies[0] - energies[-1] == pytest.approx(span)


@pytest.mark.parametrize("element", ELEMENTS)
def test_one_long_time_step_agrees_with_static_solution(element: str) -> None:
    effects = [Elasticity(Material("neo-hookean", YOUNG, 0.45)), Held(), NodalForce()]
    pull = Nodal(top_forces(BLOCK.mesh, np.array([0.5, 0.0, 0.3])))
    still = Fem(BLOCK, effects, TIGHT, "cpu", element=element).deform(Loads((pull,)))
    moving = Fem(BLOCK, [*effects, Inertia()], TIGHT, "cpu", element=element).deform(Loads((pull,), np.array([1e4])))
    np.testing.assert_allclose(moving.displacement, still.displacement, atol=1e-7 * np.abs(still.displacement).max())
    assert np.abs(moving.memory["inertia"]).max() < 1e-5


def test_second_solver_continues_time_steps_of_first_exactly() -> None:
    """A solver keeps no state: another one continues as from the start, including mid-edge nodes."""
    effects = [Elasticity(), Held(), NodalForce(), Inertia(DENSITY, 1.0)]
    mesh = box((1, 1, 1), LENGTH)
    anatomy, force = base_held(mesh), top_forces(mesh, np.array([0.4, 0.0, 0.2]))
    first, second = (Fem(anatomy, effects, TIGHT, "cpu", element="p2") for _ in range(2))
    straight = after(first, None, 4, 0.01, force)
    begun, other = after(first, None, 2, 0.01, force), after(second, None, 1, 0.003, -force)
    cut = after(second, begun, 2, 0.01, force)
    after(second, other, 1, 0.1, 2.0 * force)
    again = after(second, begun, 2, 0.01, force)
    for run in (cut, again):
        np.testing.assert_array_equal(run.displacement, straight.displacement)
        np.testing.assert_array_equal(run.memory["inertia"], straight.memory["inertia"])
    assert straight.memory["inertia"].shape == (1, first.space.count, 3)


def test_zero_time_step_leaves_body_unchanged() -> None:
    """In the first frame of a scene, and in a repeated frame: the next frame is the same."""
    fem = Fem(BLOCK, [Elasticity(), Held(), NodalForce(), Inertia(DENSITY)], TIGHT, "cpu", element="p2")
    force = top_forces(BLOCK.mesh, np.array([0.4, 0.0, 0.2]))
    first = fem.deform(Loads((Nodal(force),), np.zeros(1)))
    assert first.outcome[0].good and not first.displacement.any()
    moving = after(fem, first, 2, 0.01, force)
    paused = fem.deform(Loads((Nodal(2.0 * force),), moving.time), moving)
    assert moving.displacement.any() and moving.memory["inertia"].any()
    np.testing.assert_array_equal(paused.displacement, moving.displacement)
    np.testing.assert_array_equal(paused.memory["inertia"], moving.memory["inertia"])
    ahead, on = after(fem, moving, 1, 0.01, force), after(fem, paused, 1, 0.01, force)
    np.testing.assert_allclose(on.displacement, ahead.displacement, atol=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
def test_lumped_masses_are_positive_and_sum_to_total(element: str) -> None:
    mesh = box((2, 2, 3), LENGTH, distortion=0.2)
    mass = compute_lumped_mass(DENSITY, discretise(mesh, element))
    assert mass.min() > 0.0
    assert mass.sum() == pytest.approx(DENSITY * mesh.volumes.sum(), rel=1e-13)


def test_mass_of_curved_elements_is_density_times_volume() -> None:
    """Their inner mid-edge nodes are moved: the boundary, and so the volume, is that of a box."""
    mesh: TetMesh = quadratic(box((2, 2, 2), LENGTH), curved=0.05)
    assert compute_lumped_mass(DENSITY, discretise(mesh)).sum() == pytest.approx(DENSITY * LENGTH**3, rel=1e-12)


def dynamic(**given: float) -> Callable[[], object]:
    return lambda: Inertia(**given)


def asked(start: Deformation | None, time: float) -> Callable[[], object]:
    fem = Fem(BLOCK, [Elasticity(), Held(), Inertia()], TIGHT, "cpu", element="p1")
    return lambda: fem.deform(at(time), start)


def strange() -> Deformation:
    start = build_start(np.zeros((1, len(BLOCK.mesh.nodes), 3)))
    object.__setattr__(start, "memory", {"inertia": np.zeros((1, 5, 3))})
    return start


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (dynamic(density=0.0), r"Inertia\.density is 0\.0 kg/m\^3: give a positive"),
        (dynamic(damping=-1.0), r"Inertia\.damping is -1\.0 1/s"),
        (asked(None, -1.0), "load case 0 is at -1 s, before its start at 0 s: .* earlier deformation"),
        (asked(strange(), 1.0), r"memory of inertia has shape \(1, 5, 3\), not \(1, 27, 3\)"),
    ],
)
def test_invalid_inertia_arguments_are_rejected(build: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()


def test_preconditioner_includes_the_mass() -> None:
    """At a short step its inverse is nearly exact: a step from rest takes few iterations."""
    fem = Fem(BLOCK, [Elasticity(), Held(), NodalForce(), Inertia()], TIGHT, "cpu", element="p1")
    force = top_forces(BLOCK.mesh, np.array([0.1, 0.0, 0.0]))
    assert after(fem, None, 1, 2.0**-13, force).iterations[0] <= 4
    device = find_device("cpu", "float64")
    assert fem.problem.depends_on_step and not compile_problem([Elasticity(), Held()], BLOCK, device).depends_on_step


def test_empty_batch_with_inertia_gives_empty_result() -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), Inertia()), TIGHT, "cpu", element="p1")
    assert fem.deform(at()).displacement.shape == (0, len(BLOCK.mesh.nodes), 3)


def test_zero_time_step_does_not_move_tools() -> None:
    """A tool that moved through a body at rest would be inside it without contact force."""
    ball = Ball(0.02)
    fem = Fem(BLOCK, (Elasticity(), Held(), Inertia(), ToolContact((ball,))), Accuracy(), "cpu", element="p1")

    def pressed(height: float, time: float) -> Loads:
        pose = np.eye(4)
        pose[:3, 3] = [0.04, 0.06, height]
        return Loads((Touching(pose[None, None]),), np.array([time]))

    first = fem.deform(pressed(0.095, 0.0))
    assert not first.displacement.any() and not first.reaction.any()
    touched = fem.deform(pressed(0.095, 0.5), first)
    stays = fem.deform(pressed(0.080, 0.5), touched)
    assert touched.reaction[0, 0, 2] < 0.0 and stays.outcome[0].good
    np.testing.assert_array_equal(stays.memory["tool contact"], touched.memory["tool contact"])
    np.testing.assert_allclose(stays.reaction, touched.reaction)
    moved = fem.deform(pressed(0.080, 1.0), stays)
    nodes = BLOCK.mesh.nodes + moved.displacement[0]
    assert moved.outcome[0].good and compute_distances(ball, moved.memory["tool contact"][0, 0], nodes).min() > 0.0
    np.testing.assert_array_equal(moved.memory["tool contact"][0, 0, :3, 3], [0.04, 0.06, 0.080])


def test_residual_of_time_steps_is_rejected() -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), Inertia()), TIGHT, "cpu", element="p1")
    answer = fem.deform(at(0.1))
    with pytest.raises(InputError, match="solutions under Inertia are time steps"):
        fem.residual(at(0.1), answer)

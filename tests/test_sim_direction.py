"""Newton-CG within its radius, and L-BFGS on the rest stiffness: what each promises as a descent."""

from __future__ import annotations

import numpy as np
import pytest
from boxes import base_held, box, top_forces
from oracle import tissue

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.device import Device, find_device
from sim.direction import LBFGS, Descent, Direction, NewtonCG
from sim.effects import Elasticity, Held, NodalForce
from sim.loads import Loads, Nodal, Prescribed
from sim.newton import find_equilibrium
from sim.precondition import rest_solver
from sim.problem import Problem
from sim.search import search
from sim.term import Cases

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
FREE = ~ANATOMY.held.ravel()
TOTAL = np.array([[0.0, 0.0, -0.1], [0.2, 0.1, -0.4], [0.0, 0.0, 2.0], [0.01, 0.0, 0.0], [0.6, 0.0, -0.9]])
LOADS = Loads((Nodal(top_forces(MESH, TOTAL)),))
ACCURACY = Accuracy(tolerance=1e-9, outer=200)
DESCENTS = {"newton": lambda solver: NewtonCG(solver, 400), "l-bfgs": LBFGS}


@pytest.fixture(scope="module")
def device() -> Device:
    return find_device("cpu", "float64")


def problem_of(device: Device, law: str = "stable-neo-hookean") -> Problem:
    return compile_problem([Elasticity(tissue(law)), Held(), NodalForce()], ANATOMY, device)


def descent_of(name: str, problem: Problem) -> Descent:
    return DESCENTS[name](rest_solver(problem))


def begun(problem: Problem, loads: Loads = LOADS) -> Problem:
    problem.begin(Cases(loads, np.zeros(len(loads))))
    return problem


def walk(problem: Problem, descent: Descent, steps: int) -> list[tuple[np.ndarray, np.ndarray, Direction]]:
    """(u, g, direction) of the first steps of all columns from rest."""
    u, taken, path = problem.device.zeros(ROWS, len(TOTAL)), np.ones(len(TOTAL)), []
    descent.begin()
    for _ in range(steps):
        g, _, _ = problem.residual(u)
        found = descent.find(problem, u, g, None, np.full(len(TOTAL), 1e-6), taken)
        path.append((u.numpy().copy(), g.numpy().copy(), found))
        taken = search(problem, u, found)
        u = problem.device.array(u.numpy() + taken * found.d.numpy())
    return path


@pytest.mark.parametrize("law", ["linear", "corotational", "neo-hookean", "stable-neo-hookean", "ogden"])
def test_both_descents_find_the_same_equilibria(device: Device, law: str) -> None:
    problem, rest = problem_of(device, law), np.zeros((ROWS, len(TOTAL)))
    found = {}
    for name in DESCENTS:
        found[name] = find_equilibrium(begun(problem), descent_of(name, problem), rest, ACCURACY)
        assert all(outcome.good for outcome in found[name].outcome)
    np.testing.assert_allclose(found["l-bfgs"].u, found["newton"].u, atol=1e-6 * np.abs(found["newton"].u).max())


@pytest.mark.parametrize("name", DESCENTS)
def test_directions_lead_downhill_and_promise_their_slope(device: Device, name: str) -> None:
    problem = begun(problem_of(device))
    for _, g, found in walk(problem, descent_of(name, problem), 8):
        slope = (g * found.d.numpy()).sum(axis=0)
        assert (slope < 0.0).all()
        np.testing.assert_allclose(found.promised, -slope, rtol=1e-9)


def test_the_first_l_bfgs_step_is_the_rest_stiffness_solved(device: Device) -> None:
    """On Hooke's law it is the answer."""
    problem = begun(problem_of(device, "linear"))
    found = find_equilibrium(problem, LBFGS(rest_solver(problem)), np.zeros((ROWS, len(TOTAL))), ACCURACY)
    assert (found.iterations == 1).all()


def test_l_bfgs_meets_the_secant_condition(device: Device) -> None:
    """H y = s for the last pair: the direction against g + a y is that against g, less a s."""
    problem = begun(problem_of(device))
    (u0, g0, first), (u1, g1, second) = walk(problem, LBFGS(rest_solver(problem)), 2)
    s, y = u1 - u0, g1 - g0
    descent = LBFGS(rest_solver(problem))
    descent.find(problem, device.array(u0), device.array(g0), None, np.zeros(5), np.ones(5))
    # The step that was taken, and the gradient there, as `find` sees them.
    taken = np.linalg.norm(s, axis=0) / np.linalg.norm(first.d.numpy(), axis=0)
    again = descent.find(problem, device.array(u1), device.array(g1), None, np.zeros(5), taken)
    np.testing.assert_allclose(again.d.numpy(), second.d.numpy(), atol=1e-12 * np.abs(second.d.numpy()).max())
    # -H g and s are conjugate in the secant's sense: y . H g = s . g.
    np.testing.assert_allclose(-(y * second.d.numpy()).sum(axis=0), (s * g1).sum(axis=0), rtol=1e-6, atol=1e-15)


def test_l_bfgs_passes_by_pairs_of_negative_curvature(device: Device) -> None:
    """A gradient that falls along the step teaches nothing: the next direction is the rest stiffness's again."""
    problem = begun(problem_of(device))
    u, (g, _, _) = device.zeros(ROWS, 5), problem.residual(device.zeros(ROWS, 5))
    descent, fresh = LBFGS(rest_solver(problem)), LBFGS(rest_solver(problem))
    first = descent.find(problem, u, g, None, np.zeros(5), np.ones(5))
    worse = device.array(1.5 * g.numpy())
    second = descent.find(problem, device.array(first.d.numpy()), worse, None, np.zeros(5), np.ones(5))
    plain = fresh.find(problem, u, worse, None, np.zeros(5), np.ones(5))
    np.testing.assert_array_equal(second.d.numpy(), plain.d.numpy())


@pytest.mark.parametrize("name", DESCENTS)
def test_memory_leaves_with_its_columns(device: Device, name: str) -> None:
    """Three steps together, then some columns go on: as if they had always been alone."""
    rows = np.array([3, 0, 4])
    problem = begun(problem_of(device))
    whole = descent_of(name, problem)
    path = walk(problem, whole, 4)
    alone = begun(problem_of(device), LOADS.rows(rows))
    u, taken = device.zeros(ROWS, 3), np.ones(3)
    apart = descent_of(name, alone)
    apart.begin()
    for step in range(4):
        g, _, _ = alone.residual(u)
        found = apart.find(alone, u, g, None, np.full(3, 1e-6), taken)
        np.testing.assert_allclose(
            found.d.numpy(), path[step][2].d.numpy()[:, rows], atol=1e-9 * np.abs(found.d.numpy()).max()
        )
        taken = search(alone, u, found)
        u = device.array(u.numpy() + taken * found.d.numpy())
    whole.keep(device, rows)
    problem.keep(rows)
    g, _, _ = problem.residual(u)
    kept = whole.find(problem, u, g, None, np.full(3, 1e-6), taken).d.numpy()
    np.testing.assert_allclose(
        kept, apart.find(alone, u, g, None, np.full(3, 1e-6), taken).d.numpy(), atol=1e-9 * np.abs(kept).max()
    )


@pytest.mark.parametrize("name", DESCENTS)
def test_a_gap_is_closed_by_the_first_whole_step(device: Device, name: str) -> None:
    top = MESH.nodes[:, 2] > 0.1 - 1e-9
    anatomy = type(ANATOMY)(MESH, ANATOMY.held | top[:, None], ANATOMY.slide_normal, ANATOMY.craniotomy)
    value = np.where(top[:, None], [1e-3, 0.0, -2e-3], 0.0)
    problem = compile_problem([Elasticity(), Held()], anatomy, device)
    problem.begin(Cases(Loads((Prescribed(value[None]),)), np.zeros(1)))
    one = find_equilibrium(problem, descent_of(name, problem), np.zeros((ROWS, 1)), Accuracy(tolerance=1e-9, outer=1))
    np.testing.assert_allclose(one.u.reshape(-1, 3)[top], value[top], atol=1e-15)
    problem.begin(Cases(Loads((Prescribed(value[None]),)), np.zeros(1)))
    done = find_equilibrium(problem, descent_of(name, problem), np.zeros((ROWS, 1)), Accuracy(tolerance=1e-9))
    assert done.outcome[0].good


def test_newtons_radius_follows_the_steps(device: Device) -> None:
    """What follows a step that was cut to a tenth is at most twice that long, in the norm of the rest stiffness."""
    problem = begun(problem_of(device))
    K = problem.rest_curvature()

    def size(d: np.ndarray) -> np.ndarray:
        return np.sqrt((d * (K @ d)).sum(axis=0))

    descent, u = NewtonCG(rest_solver(problem), 400), device.zeros(ROWS, 5)
    g, _, _ = problem.residual(u)
    first = descent.find(problem, u, g, None, np.full(5, 1e-9), np.ones(5)).d.numpy()
    second = descent.find(problem, u, g, None, np.full(5, 1e-9), np.full(5, 0.1)).d.numpy()
    np.testing.assert_allclose(size(second), 0.2 * size(first), rtol=1e-8)
    third = descent.find(problem, u, g, None, np.full(5, 1e-9), np.ones(5)).d.numpy()
    np.testing.assert_allclose(size(third), 0.4 * size(first), rtol=1e-8)
    misled = descent.find(problem, u, g, None, np.full(5, 1e-9), np.zeros(5)).d.numpy()
    np.testing.assert_allclose(misled, first, atol=1e-8 * np.abs(first).max())

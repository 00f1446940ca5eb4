"""Newton-CG within its trust radius: requirements of a descent."""

import numpy as np
from boxes import base_held, box, top_forces
from oracle import tissue

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal, Prescribed
from sim.minimisers.line_search import search_line
from sim.minimisers.newton import find_equilibrium
from sim.minimisers.newton_cg import DescentMethod, Direction, NewtonCG
from sim.runtime.device import Device

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
TOTAL = np.array([[0.0, 0.0, -0.1], [0.2, 0.1, -0.4], [0.0, 0.0, 2.0], [0.01, 0.0, 0.0], [0.6, 0.0, -0.9]])
LOADS = Loads((Nodal(top_forces(MESH, TOTAL)),))


def read_problem(device: Device, law: str = "stable-neo-hookean") -> Problem:
    return compile_problem([Elasticity(tissue(law)), Held(), NodalForce()], ANATOMY, device)


def descent_of(problem: Problem) -> DescentMethod:
    return NewtonCG(build_rest_solver(problem), 400)


def begun(problem: Problem, loads: Loads = LOADS) -> Problem:
    problem.begin(Cases(loads, np.zeros(len(loads))))
    return problem


def walk(problem: Problem, descent: DescentMethod, steps: int) -> list[tuple[np.ndarray, np.ndarray, Direction]]:
    """(u, g, direction) of the first steps of all columns from rest."""
    u, taken, path = problem.device.allocate(ROWS, len(TOTAL)), np.ones(len(TOTAL)), []
    descent.begin()
    for _ in range(steps):
        g, _, _ = problem.residual(u)
        found = descent.find_direction(problem, u, g, None, np.full(len(TOTAL), 1e-9), taken)
        path.append((u.numpy().copy(), g.numpy().copy(), found))
        taken = search_line(problem, u, found)
        u = problem.device.upload(u.numpy() + taken * found.d.numpy())
    return path


def test_newton_cg_directions_are_downhill_and_predict_slope(device: Device) -> None:
    problem = begun(read_problem(device))
    for _, g, found in walk(problem, descent_of(problem), 8):
        slope = (g * found.d.numpy()).sum(axis=0)
        assert (slope < 0.0).all()
        np.testing.assert_allclose(found.decrease, -slope, rtol=1e-9)


def test_newton_cg_forgets_memory_of_removed_columns(device: Device) -> None:
    """Three steps together, then some columns continue as if they had always been separate."""
    rows = np.array([3, 0, 4])
    problem = begun(read_problem(device))
    whole = descent_of(problem)
    path = walk(problem, whole, 4)
    alone = begun(read_problem(device), LOADS.select(rows))
    u, taken = device.allocate(ROWS, 3), np.ones(3)
    apart = descent_of(alone)
    apart.begin()
    for step in range(4):
        g, _, _ = alone.residual(u)
        found = apart.find_direction(alone, u, g, None, np.full(3, 1e-9), taken)
        np.testing.assert_allclose(
            found.d.numpy(), path[step][2].d.numpy()[:, rows], atol=1e-8 * np.abs(found.d.numpy()).max()
        )
        taken = search_line(alone, u, found)
        u = device.upload(u.numpy() + taken * found.d.numpy())
    whole.keep(device, rows)
    problem.keep(rows)
    g, _, _ = problem.residual(u)
    kept = whole.find_direction(problem, u, g, None, np.full(3, 1e-9), taken).d.numpy()
    np.testing.assert_allclose(
        kept, apart.find_direction(alone, u, g, None, np.full(3, 1e-9), taken).d.numpy(), atol=1e-8 * np.abs(kept).max()
    )


def test_first_full_step_closes_the_constraint_gap(device: Device) -> None:
    top = MESH.nodes[:, 2] > 0.1 - 1e-9
    anatomy = type(ANATOMY)(MESH, ANATOMY.fixed | top[:, None], ANATOMY.slide_normal, ANATOMY.craniotomy)
    value = np.where(top[:, None], [1e-3, 0.0, -2e-3], 0.0)
    problem = compile_problem([Elasticity(), Held()], anatomy, device)
    problem.begin(Cases(Loads((Prescribed(value[None]),)), np.zeros(1)))
    one = find_equilibrium(problem, descent_of(problem), device.allocate(ROWS, 1), Accuracy(tolerance=1e-9, outer=1))
    np.testing.assert_allclose(one.u.numpy().reshape(-1, 3)[top], value[top], atol=1e-15)
    problem.begin(Cases(Loads((Prescribed(value[None]),)), np.zeros(1)))
    done = find_equilibrium(problem, descent_of(problem), device.allocate(ROWS, 1), Accuracy(tolerance=1e-9))
    assert done.outcome[0].good


def test_trust_radius_follows_accepted_steps(device: Device) -> None:
    """After a step cut to a tenth, the next is at most twice that long, in the norm of the rest stiffness."""
    problem = begun(read_problem(device))
    K = problem.rest_curvature()

    def size(d: np.ndarray) -> np.ndarray:
        return np.sqrt((d * (K @ d)).sum(axis=0))

    descent, u = NewtonCG(build_rest_solver(problem), 400), device.allocate(ROWS, 5)
    g, _, _ = problem.residual(u)
    first = descent.find_direction(problem, u, g, None, np.full(5, 1e-9), np.ones(5)).d.numpy()
    second = descent.find_direction(problem, u, g, None, np.full(5, 1e-9), np.full(5, 0.1)).d.numpy()
    np.testing.assert_allclose(size(second), 0.2 * size(first), rtol=1e-8)
    third = descent.find_direction(problem, u, g, None, np.full(5, 1e-9), np.ones(5)).d.numpy()
    np.testing.assert_allclose(size(third), 0.4 * size(first), rtol=1e-8)
    misled = descent.find_direction(problem, u, g, None, np.full(5, 1e-9), np.zeros(5)).d.numpy()
    np.testing.assert_allclose(misled, first, atol=1e-8 * np.abs(first).max())

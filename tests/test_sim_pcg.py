"""Conjugate gradients, their preconditioners and the line search, each against dense algebra."""

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box, top_forces

from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce
from sim.linalg.pcg import BlockJacobi, Preconditioner, solve_conjugate_gradients
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal
from sim.material import Material
from sim.minimisers.line_search import search_line
from sim.minimisers.newton_cg import Direction
from sim.runtime.device import Device

MESH = box((2, 2, 2), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
FREE = np.flatnonzero(~ANATOMY.fixed.ravel())
FORCE = top_forces(MESH, np.array([[0.0, 0.1, -0.2], [0.3, 0.0, 0.1]]))
CRUSHED = np.repeat((MESH.nodes * [0.15, 0.15, -0.55]).reshape(-1, 1), 2, axis=1)
REST = np.zeros((ROWS, 2))


@pytest.fixture
def problem(device: Device) -> Problem:
    out = compile_problem([Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), NodalForce()], ANATOMY, device)
    out.begin(Cases(Loads((Nodal(FORCE),)), np.zeros(2)))
    return out


@pytest.fixture(params=["factor", "block jacobi"])
def preconditioner(request: pytest.FixtureRequest, problem: Problem) -> Preconditioner:
    return build_rest_solver(problem) if request.param == "factor" else BlockJacobi(problem.device)


def compute_right_hand_side(problem: Problem) -> np.ndarray:
    """Projected, one column much larger than the other."""
    r = FORCE.reshape(2, -1).T * [1.0, 1e-6]
    array = problem.device.upload(r)
    problem.constraint.project(array)
    return array.numpy()


def dense(problem: Problem, u: np.ndarray) -> np.ndarray:
    """Free curvature (n, n) at the first column of u, after linearising there."""
    problem.linearise(problem.device.upload(u), np.zeros(u.shape[1], bool))
    columns = []
    for row in FREE:
        p = np.zeros(u.shape)
        p[row] = 1.0
        out = problem.device.allocate(*u.shape)
        problem.add_curvature(problem.device.upload(p), out)
        columns.append(out.numpy()[FREE, 0])
    return np.array(columns).T


def solve(problem: Problem, preconditioner: Preconditioner, r: np.ndarray, tolerance: np.ndarray, most: int):
    preconditioner.prepare(problem, r.shape[1])
    return solve_conjugate_gradients(problem, preconditioner, problem.device.upload(r), tolerance, most)


def test_pcg_solves_each_column_to_the_tolerance(problem: Problem, preconditioner: Preconditioner) -> None:
    K, r = dense(problem, 1e-2 * CRUSHED), compute_right_hand_side(problem)
    found = solve(problem, preconditioner, r, 1e-10 * np.linalg.norm(r, axis=0), 400)
    x = found.x.numpy()
    assert not np.delete(x, FREE, axis=0).any()
    for column in range(2):
        left = r[FREE, column] - K @ x[FREE, column]
        assert np.linalg.norm(left) < 1.1e-10 * np.linalg.norm(r[:, column])
    assert not found.truncated.any()


def test_pcg_needs_no_more_iterations_than_unknowns(problem: Problem, preconditioner: Preconditioner) -> None:
    """Directions are conjugate: exact arithmetic ends after n steps; steepest descent takes hundreds."""
    dense(problem, 1e-2 * CRUSHED)
    r = compute_right_hand_side(problem)
    found = solve(problem, preconditioner, r, 1e-8 * np.linalg.norm(r, axis=0), 1000)
    assert found.iterations <= (1.2 * len(FREE) if isinstance(preconditioner, BlockJacobi) else 8)


def test_factor_inverts_the_rest_stiffness(problem: Problem) -> None:
    K, r = dense(problem, REST), compute_right_hand_side(problem)
    out = problem.device.allocate(*r.shape)
    build_rest_solver(problem).apply(problem.device.upload(r), np.ones(2, bool), out)
    np.testing.assert_allclose(out.numpy()[FREE], np.linalg.solve(K, r[FREE]), rtol=1e-9, atol=1e-18)


def test_negative_curvature_gives_a_descent_direction(problem: Problem, preconditioner: Preconditioner) -> None:
    K, r = dense(problem, CRUSHED), compute_right_hand_side(problem)
    assert np.linalg.eigvalsh(K)[0] < 0.0
    found = solve(problem, preconditioner, r, 1e-10 * np.linalg.norm(r, axis=0), 400)
    x = found.x.numpy()
    assert found.truncated.all()
    assert np.isfinite(x).all()
    assert ((x * r).sum(axis=0) > 0.0).all()
    # Steihaug: what was gathered lies where the model still curves upwards, or it is the first direction.
    curved = np.einsum("ic,ij,jc->c", x[FREE], K, x[FREE])
    out = problem.device.allocate(*r.shape)
    preconditioner.apply(problem.device.upload(r), np.ones(2, bool), out)
    problem.constraint.project(out)
    first = np.abs(x - out.numpy()).max(axis=0) < 1e-12 * np.abs(x).max(axis=0)
    assert ((curved > 0.0) | first).all()


def test_pcg_ends_at_its_iteration_budget(problem: Problem) -> None:
    dense(problem, 1e-2 * CRUSHED)
    r = compute_right_hand_side(problem)
    found = solve(problem, BlockJacobi(problem.device), r, np.zeros(2), 5)
    assert found.iterations == 5
    assert np.isfinite(found.x.numpy()).all()


def test_pcg_solution_for_zero_force_is_zero(problem: Problem, preconditioner: Preconditioner) -> None:
    dense(problem, REST)
    found = solve(problem, preconditioner, np.zeros((ROWS, 2)), np.zeros(2), 400)
    assert found.iterations == 0
    assert not found.x.numpy().any()


def downhill(problem: Problem, sign: np.ndarray) -> tuple[wp.array, Direction]:
    """At rest: minus the free gradient scaled to a motion of millimetres, times a sign per column."""
    u = problem.device.allocate(ROWS, 2)
    g = problem.gradient(u)
    problem.constraint.project(g)
    d = -sign * g.numpy() * 1e-3 / np.abs(g.numpy()).max(axis=0)
    return u, Direction(problem.device.upload(d), np.abs((g.numpy() * d).sum(axis=0)), 0)


def test_line_search_lowers_the_energy(problem: Problem) -> None:
    u, direction = downhill(problem, np.ones(2))
    length = search_line(problem, u, direction)
    assert ((length > 0.0) & (length <= 1.0)).all()
    before = problem.energy(u)
    moved = problem.device.upload(length * direction.d.numpy())
    assert (problem.energy(moved) < before).all()


def test_line_search_returns_zero_only_for_uphill_direction(problem: Problem) -> None:
    u, direction = downhill(problem, np.array([1.0, -1.0]))
    length = search_line(problem, u, direction)
    assert length[0] > 0.0
    assert length[1] == 0.0


def test_line_search_does_not_change_its_arguments(problem: Problem) -> None:
    u, direction = downhill(problem, np.ones(2))
    before = direction.d.numpy().copy()
    search_line(problem, u, direction)
    assert not u.numpy().any()
    np.testing.assert_array_equal(direction.d.numpy(), before)


def test_trust_radius_bounds_solution_in_preconditioner_norm(problem: Problem) -> None:
    """Half of the norm of the full solution, less where the curvature is negative; a large radius has no effect."""
    K, r = dense(problem, 1e-2 * CRUSHED), compute_right_hand_side(problem)
    rest, solver = dense(problem, REST), build_rest_solver(problem)
    tolerance = 1e-10 * np.linalg.norm(r, axis=0)

    def size(x: np.ndarray) -> np.ndarray:
        return np.sqrt(np.einsum("ic,ij,jc->c", x[FREE], rest, x[FREE]))

    def solution(at: np.ndarray, radius: np.ndarray | None):
        problem.linearise(problem.device.upload(at), np.zeros(2, bool))
        return solve_conjugate_gradients(problem, solver, problem.device.upload(r), tolerance, 400, radius)

    whole = solution(1e-2 * CRUSHED, None)
    np.testing.assert_allclose(whole.norm, size(whole.x.numpy()), rtol=1e-9)
    same = solution(1e-2 * CRUSHED, 2.0 * whole.norm)
    np.testing.assert_array_equal(same.x.numpy(), whole.x.numpy())
    half = solution(1e-2 * CRUSHED, 0.5 * whole.norm)
    assert half.truncated.all()
    np.testing.assert_allclose(size(half.x.numpy()), 0.5 * whole.norm, rtol=1e-9)
    negative = solution(CRUSHED, 0.1 * whole.norm)
    np.testing.assert_allclose(size(negative.x.numpy()), 0.1 * whole.norm, rtol=1e-9)
    assert ((negative.x.numpy() * r).sum(axis=0) > 0.0).all()
    # Within the ball the model falls with every iteration: the shorter solution is the worse one.
    model = [0.5 * np.einsum("ic,ij,jc->c", x[FREE], K, x[FREE]) - (x * r).sum(axis=0) for x in
             (half.x.numpy(), whole.x.numpy())]  # fmt: skip
    assert (model[1] < model[0]).all()


def test_line_search_extends_a_step_that_was_cut_too_much(problem: Problem) -> None:
    """Along a direction that is far too long it ends near the minimum."""
    u, direction = downhill(problem, np.ones(2))
    far = 37.0 / search_line(problem, u, direction)
    long = Direction(problem.device.upload(far * direction.d.numpy()), far * direction.decrease, 0)
    length = search_line(problem, u, long)

    def slope(t: np.ndarray) -> np.ndarray:
        g = problem.gradient(problem.device.upload(t * long.d.numpy()))
        problem.constraint.project(g)
        return (g.numpy() * long.d.numpy()).sum(axis=0)

    assert (np.abs(slope(length)) <= 0.5 * long.decrease).all()


def test_line_search_rejects_negligible_step(problem: Problem) -> None:
    """Only a step of 1e-10 of the direction lowers the energy."""
    u, direction = downhill(problem, np.ones(2))
    length = search_line(problem, u, direction)
    far = 1e10 * length
    endless = Direction(problem.device.upload(far * direction.d.numpy()), far * direction.decrease, 0)
    assert not search_line(problem, u, endless).any()

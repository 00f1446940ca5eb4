"""L-BFGS on many columns: the textbook algorithm for each column, and the host's work between iterations."""

import numpy as np
import pytest
from boxes import base_held, box, top_forces
from on_host import equilibrium_of
from oracle import tissue
from tiny_terms import Wall

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Effect, Elasticity, Held, NodalForce
from sim.linalg.pcg import BlockJacobi
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal
from sim.minimisers.lbfgs import DescentResult, Lbfgs
from sim.minimisers.lbfgs_kernels import DONE, LIVE, NOT_FINITE, PAIRS, STOPPED
from sim.minimisers.newton_cg import NewtonCG
from sim.runtime.device import Device, find_device

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
FREE = ~ANATOMY.fixed.ravel()
TOTAL = np.array([[0.0, 0.0, -0.1], [0.2, 0.1, -0.4], [0.0, 0.0, 2.0], [0.01, 0.0, 0.0], [0.6, 0.0, -0.9], [0, 0, 0]])
FINE = 1e-9


def read_problem(device: Device, law: str = "stable-neo-hookean", total: np.ndarray = TOTAL) -> Problem:
    effects: list[Effect] = [Elasticity(tissue(law)), Held(), NodalForce()]
    problem = compile_problem(effects, ANATOMY, device)
    problem.begin(Cases(Loads((Nodal(top_forces(MESH, total)),)), np.zeros(len(total))))
    return problem


def descended(
    problem: Problem, start: np.ndarray | None = None, tolerance: float = FINE, most: int = 300
) -> DescentResult:
    count = len(TOTAL) if start is None else start.shape[1]
    start = np.zeros((ROWS, count)) if start is None else start
    solver = build_rest_solver(problem)
    return Lbfgs(problem, solver).descend(problem.device.upload(start), np.full(count, tolerance), most)


def book(problem: Problem, steps: int) -> np.ndarray:
    """u (3N,) of one column after so many steps of Nocedal and Wright's two loops.

    Each is as long as the one before it should have been by the secant of its slopes, at most whole.
    """
    device, solver = problem.device, build_rest_solver(problem)

    def gradient(u: np.ndarray) -> np.ndarray:
        g = problem.gradient(device.upload(u[:, None]))
        problem.constraint.project(g)
        return g.numpy()[:, 0].copy()

    def solved(r: np.ndarray) -> np.ndarray:
        out = device.allocate(ROWS, 1)
        solver.apply(device.upload(r[:, None]), np.ones(1, bool), out)
        return out.numpy()[:, 0].copy()

    u, g, pairs, t = np.zeros(ROWS), gradient(np.zeros(ROWS)), [], 1.0
    for _ in range(steps):
        q, weights = g.copy(), []
        for s, y in reversed(pairs):
            weights.append(s @ q / (s @ y))
            q -= weights[-1] * y
        x = solved(q)
        for (s, y), weight in zip(pairs, reversed(weights), strict=True):
            x += (weight - y @ x / (s @ y)) * s
        slope = gradient(u - t * x) @ -x
        assert slope <= 0.5 * g @ x  # the loads here let every such step pass
        pairs = [*pairs, (-t * x, gradient(u - t * x) - g)][-PAIRS:]
        u, t, g = u - t * x, min(1.0, t * (g @ x) / (slope + g @ x)), gradient(u - t * x)
    return u


def test_lbfgs_steps_agree_with_textbook_algorithm(device: Device) -> None:
    """More steps than pairs: the oldest are dropped first."""
    mild = TOTAL[1:2]
    for steps in (1, 2, 5, PAIRS + 3):
        found = descended(read_problem(device, total=mild), np.zeros((ROWS, 1)), 1e-300, steps + 1)
        assert found.steps[0] == steps
        expected = book(read_problem(device, total=mild), steps)
        np.testing.assert_allclose(found.u.numpy()[:, 0], expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("law", ["linear", "corotational", "neo-hookean", "stable-neo-hookean", "ogden"])
def test_lbfgs_agrees_with_newton(device: Device, law: str) -> None:
    problem = read_problem(device, law)
    found = descended(problem)
    assert (found.status == DONE).all()
    assert (found.residual <= FINE).all()
    problem = read_problem(device, law)
    newton = NewtonCG(build_rest_solver(problem), 400)
    exact = equilibrium_of(problem, newton, np.zeros((ROWS, len(TOTAL))), Accuracy(tolerance=FINE))
    np.testing.assert_allclose(found.u.numpy(), exact.u, atol=1e-6 * np.abs(exact.u).max())
    again = read_problem(device, law)
    _, free, scale = again.residual(found.u)
    np.testing.assert_allclose(found.residual[:-1], free[:-1] / scale[:-1], rtol=1e-4, atol=1e-15)


def test_linear_law_converges_in_one_lbfgs_step(device: Device) -> None:
    found = descended(read_problem(device, "linear"))
    np.testing.assert_array_equal(found.steps, [1, 1, 1, 1, 1, 0])
    assert not found.u.numpy()[:, -1].any()


def test_lbfgs_columns_are_independent(device: Device) -> None:
    """Columns that end sooner or later do not change the others."""
    whole = descended(read_problem(device))
    for row in range(len(TOTAL)):
        alone = descended(read_problem(device, total=TOTAL[[row]]), np.zeros((ROWS, 1)))
        assert alone.steps[0] == whole.steps[row]
        np.testing.assert_allclose(alone.u.numpy()[:, 0], whole.u.numpy()[:, row], atol=1e-12)


def test_lbfgs_out_of_budget_returns_last_accepted_state(device: Device) -> None:
    found = descended(read_problem(device), most=6)
    np.testing.assert_array_equal(found.unfinished_cases, np.flatnonzero(found.status != DONE))
    assert len(found.unfinished_cases) >= 2
    _, free, scale = read_problem(device).residual(found.u)
    np.testing.assert_allclose(free[:-1] / scale[:-1], found.residual[:-1], rtol=1e-5)
    assert (found.residual[found.unfinished_cases] > FINE).all()


def test_lbfgs_reports_non_finite_start(device: Device) -> None:
    start = np.zeros((ROWS, len(TOTAL)))
    start[FREE, 1] = 1e200
    found = descended(read_problem(device), start)
    assert found.status[1] == NOT_FINITE
    assert (np.delete(found.status, 1) == DONE).all()


def test_overflowing_forces_are_not_an_equilibrium() -> None:
    """In single precision, at held nodes first: free forces are negligible compared with them."""
    single, power = find_device("cpu", "float32"), np.arange(2, 34, 0.5)
    problem = read_problem(single, total=np.tile(TOTAL[1], (len(power), 1)))
    start = np.random.default_rng(0).normal(size=(ROWS, 1)) * FREE[:, None] * 10.0**power
    _, free, scale = problem.residual(single.upload(start))
    with np.errstate(invalid="ignore"):
        assert not (free / scale <= 1e-4).any() and not np.isfinite(scale).all()
    tolerance = np.full(len(power), 1e-4)
    found = Lbfgs(problem, build_rest_solver(problem)).descend(single.upload(start), tolerance, 1)
    assert not (found.status == DONE).any() and (found.status == NOT_FINITE).any()


def test_lbfgs_steps_stay_inside_the_domain(device: Device) -> None:
    """Pulled towards a wall, no state crosses it, neither on the path nor at the end."""
    problem = read_problem(device, "neo-hookean")
    wall = Wall(device, MESH.nodes, 0.105, 4e-3, 1.0)
    walled = Problem((*problem.terms, wall), problem.constraint, device)
    walled.begin(Cases(Loads((Nodal(top_forces(MESH, TOTAL)),)), np.zeros(len(TOTAL))))
    for most in (1, 2, 3, 5, 8, 200):
        found = Lbfgs(walled, build_rest_solver(problem)).descend(
            device.allocate(ROWS, len(TOTAL)), np.full(len(TOTAL), 1e-7), most
        )
        assert wall.distance(found.u.numpy()).min() > 0.0
        walled.begin(Cases(Loads((Nodal(top_forces(MESH, TOTAL)),)), np.zeros(len(TOTAL))))
    assert np.isin(found.status, [DONE, STOPPED, LIVE]).all()
    assert found.status[0] == DONE
    assert wall.distance(found.u.numpy())[:, 2].min() < 5e-3


def test_lbfgs_converges_with_any_preconditioner(device: Device) -> None:
    problem = read_problem(device)
    jacobi = Lbfgs(problem, BlockJacobi(device)).descend(
        device.allocate(ROWS, len(TOTAL)), np.full(len(TOTAL), 1e-6), 2000
    )
    assert (jacobi.status == DONE).all()
    exact = descended(read_problem(device)).u.numpy()
    np.testing.assert_allclose(jacobi.u.numpy(), exact, atol=1e-3 * np.abs(exact).max())


def test_lbfgs_converges_in_single_precision() -> None:
    single = find_device("cpu", "float32")
    found = descended(read_problem(single), tolerance=2e-5)
    assert (found.status == DONE).all()


def test_curvature_pairs_shorten_the_next_descent(device: Device) -> None:
    """The load grows by a tenth: the pairs of the last descent remain valid."""
    few, rest = TOTAL[:3], device.allocate(ROWS, 3)
    problem = read_problem(device, total=few)
    solver, tolerance = build_rest_solver(problem), np.full(3, 1e-6)
    first = Lbfgs(problem, solver).descend(rest, tolerance, 300, {})
    plain = Lbfgs(read_problem(device, total=1.1 * few), solver).descend(first.u, tolerance, 300)
    carried = Lbfgs(read_problem(device, total=1.1 * few), solver).descend(first.u, tolerance, 300, first.warm_start)
    assert (carried.status == DONE).all()
    assert carried.steps.sum() < plain.steps.sum()
    np.testing.assert_allclose(carried.u.numpy(), plain.u.numpy(), atol=1e-4 * np.abs(plain.u.numpy()).max())
    assert not descended(read_problem(device)).warm_start  # too many columns to have a next frame


def test_lbfgs_column_also_ends_at_force_tolerance(device: Device) -> None:
    problem = read_problem(device)
    force = np.array([0.0, 1e-3, 0.0, 1e-4, 0.0, 0.0])
    start, count = device.allocate(ROWS, len(TOTAL)), len(TOTAL)
    found = Lbfgs(problem, build_rest_solver(problem)).descend(start, np.full(count, FINE), 300, force_tolerance=force)
    _, free, _ = read_problem(device).residual(found.u)
    assert (found.status == DONE).all() and (found.residual[[1, 3]] > 100.0 * FINE).all()
    assert (free[[1, 3]] <= force[[1, 3]]).all()


def test_lbfgs_stops_when_few_columns_remain(device: Device) -> None:
    problem = read_problem(device)
    start, count = device.allocate(ROWS, len(TOTAL)), len(TOTAL)
    found = Lbfgs(problem, build_rest_solver(problem)).descend(start, np.full(count, FINE), 300, straggler_fraction=0.4)
    assert 1 <= (found.status == LIVE).sum() <= 2
    assert (found.residual[found.status == LIVE] < 1.0).all()


@pytest.mark.parametrize("law", ["stable-neo-hookean", "neo-hookean"])
def test_known_gradient_replaces_the_first_evaluation(device: Device, law: str) -> None:
    """The following steps are the same, the first of them within the domain."""
    problem = read_problem(device, law)
    solver, start = build_rest_solver(problem), device.allocate(ROWS, len(TOTAL))
    tolerance = np.full(len(TOTAL), FINE)
    plain = Lbfgs(problem, solver).descend(start, tolerance, 300)
    problem = read_problem(device, law)
    g, _, _ = problem.residual(start)
    z = device.allocate(ROWS, len(TOTAL))
    solver.apply(g, np.ones(len(TOTAL), bool), z)
    looks = []
    term = next(term for term in problem.terms if not term.constant)
    whole = term.add_gradient
    term.add_gradient = lambda u, out: (looks.append(1), whole(u, out))
    found = Lbfgs(problem, solver).descend(start, tolerance, 300, initial_residual=(g, z))
    assert (found.steps[:-1] == plain.steps[:-1]).all()
    np.testing.assert_allclose(found.u.numpy(), plain.u.numpy(), atol=1e-9)
    assert len(looks) >= found.steps.max()


def test_lbfgs_batch_is_independent_of_previous_batch(device: Device) -> None:
    """A narrower workspace replaces a wider one: its old values must not scale a residual."""
    problem = read_problem(device, total=np.tile(50.0 * TOTAL[1], (8, 1)))
    solver, few = build_rest_solver(problem), TOTAL[[0, 1, 3]]
    lbfgs = Lbfgs(problem, solver)
    lbfgs.descend(device.allocate(ROWS, 8), np.full(8, FINE), 300)
    problem.begin(Cases(Loads((Nodal(top_forces(MESH, few)),)), np.zeros(3)))
    again = lbfgs.descend(device.allocate(ROWS, 3), np.full(3, 1e-4), 300)
    fresh = Lbfgs(read_problem(device, total=few), solver).descend(device.allocate(ROWS, 3), np.full(3, 1e-4), 300)
    np.testing.assert_array_equal(again.u.numpy(), fresh.u.numpy())
    np.testing.assert_array_equal(again.residual, fresh.residual)

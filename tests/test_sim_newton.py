"""The outer iteration on a body with a creeping spring and a wall: batches, criteria, hard cases."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box, hold, top_forces
from on_host import Found, equilibrium_of
from oracle import EVERY_LAW, internal_forces, tissue
from tiny_terms import Spring, Wall

from sim.accuracy import Accuracy, Precision
from sim.compile import compile_problem
from sim.deformation import Outcome
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.linalg.pcg import BlockJacobi
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal, Prescribed
from sim.minimisers.newton_cg import Direction, NewtonCG
from sim.runtime.device import Device, find_device

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
COUNT, ROWS = len(MESH.nodes), MESH.nodes.size
FREE = ~ANATOMY.fixed
CEILING = 0.102
TIGHT = Accuracy(tolerance=1e-10)


def read_problem(device: Device, law: str = "stable-neo-hookean") -> Problem:
    """Elasticity, nodal forces, a spring with memory, and a wall 2 mm above the body."""
    material = tissue(law)
    plain = compile_problem([Elasticity(material), Held(), NodalForce()], ANATOMY, device)
    extra = Spring(device, ROWS, 0.5), Wall(device, MESH.nodes, CEILING, 1.5e-3, 1e4)
    return Problem((*plain.terms, *extra), plain.constraint, device, plain.build_imposed)


# From nothing through a hair to a press, and pulls into the wall: they are done at different steps.
TOTAL = np.array(
    [[0, 0, 0], [0, 0, -1e-7], [0.01, 0, -0.02], [0, 0, 0.3], [0.2, 0.1, -0.4], [0, 0, 2.0], [0.6, 0, -0.9]]
)


def cases_of(total: np.ndarray = TOTAL, time: float = 0.7) -> Cases:
    count = len(total)
    memory = 2e-4 * np.random.default_rng(3).normal(size=(len(TOTAL), COUNT, 3))[:count]
    loads = Loads((Nodal(top_forces(MESH, total)),), np.full(count, time))
    return Cases(loads, np.zeros(count), {"spring": memory})


def select_rows(cases: Cases, index: np.ndarray) -> Cases:
    memory = {name: value[index] for name, value in cases.memory.items()}
    return Cases(cases.loads.select(index), cases.start_time[index], memory)


def solve(problem: Problem, cases: Cases, accuracy: Accuracy = TIGHT, start: np.ndarray | None = None) -> Found:
    problem.begin(cases)
    direction = NewtonCG(build_rest_solver(problem), accuracy.inner)
    guess = np.zeros((ROWS, len(cases.loads))) if start is None else start
    return equilibrium_of(problem, direction, guess, accuracy)


@pytest.fixture(scope="module")
def problem(device: Device) -> Problem:
    return read_problem(device)


@pytest.fixture(scope="module")
def batch(problem: Problem) -> Found:
    return solve(problem, cases_of())


def test_batch_cases_converge_after_different_steps(batch: Found) -> None:
    """The tests below need different numbers of steps."""
    assert all(outcome is Outcome.CONVERGED for outcome in batch.outcome)
    assert len(set(batch.iterations)) >= 4


def test_newton_batch_agrees_with_separate_rows(problem: Problem, batch: Found) -> None:
    for row in range(len(TOTAL)):
        alone = solve(problem, select_rows(cases_of(), np.array([row])))
        np.testing.assert_allclose(alone.u[:, 0], batch.u[:, row], atol=1e-8 * max(np.abs(batch.u[:, row]).max(), 1e-3))
        assert alone.iterations[0] == batch.iterations[row]


def test_newton_rows_are_independent_of_order(problem: Problem, batch: Found) -> None:
    order = np.array([5, 0, 6, 2, 1, 4, 3])
    shuffled = solve(problem, select_rows(cases_of(), order))
    np.testing.assert_allclose(shuffled.u, batch.u[:, order], atol=1e-10)


def test_history_is_stored_by_load_case(problem: Problem, batch: Found, device: Device) -> None:
    cases = cases_of()
    problem.begin(cases)
    memory = problem.end(device.upload(batch.u))
    assert list(memory) == ["spring"]
    before, u = cases.memory["spring"], batch.u.T.reshape(len(TOTAL), COUNT, 3)
    np.testing.assert_allclose(memory["spring"], before + (1.0 - np.exp(-0.7)) * (u - before), atol=1e-14)


def test_deformer_passes_history_to_the_next_frame() -> None:
    """Creeping spring: the displacement grows with each call, and equals that of separate steps in a batch."""
    fem = Fem(ANATOMY, [Elasticity(), Held(), NodalForce()], TIGHT, "cpu", batch=2, element="p1")
    terms = (*fem.problem.terms, Spring(fem.problem.device, ROWS, 40.0))
    fem.strategy = replace(fem.strategy, problem=Problem(terms, fem.problem.constraint, fem.problem.device))
    total = np.array([[0.0, 0.0, -0.1], [0.05, 0.0, 0.02], [0.0, 0.0, -0.3]])

    def walk(rows: np.ndarray) -> list[np.ndarray]:
        state, path, anchor, begun = None, [], np.zeros((len(rows), COUNT, 3)), 0.0
        for time in (0.5, 1.0, 3.0):
            loads = Loads((Nodal(top_forces(MESH, total[rows])),), np.full(len(rows), time))
            state = fem.deform(loads, state)
            anchor += (1.0 - np.exp(begun - time)) * (state.displacement - anchor)
            np.testing.assert_allclose(state.memory["spring"], anchor, atol=1e-14)
            begun = time
            path.append(state.displacement)
        return path

    together = walk(np.arange(3))
    depth = [-state[0, :, 2].min() for state in together]
    assert depth[0] < depth[1] < depth[2]
    for row in range(3):
        for whole, alone in zip(together, walk(np.array([row])), strict=True):
            np.testing.assert_allclose(alone[0], whole[row], atol=1e-10)


def test_newton_never_crosses_the_wall(problem: Problem, batch: Found, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither in the results nor on the path: every evaluated state lies below it."""
    wall = next(term for term in problem.terms if isinstance(term, Wall))
    assert wall.distance(batch.u).min() > 0.0
    assert wall.distance(batch.u)[:, 5].min() < 1.5e-3  # the strong pull is held by it
    seen: list[float] = []
    plain = Wall.add_gradient

    def watching(self: Wall, u: wp.array, out: wp.array) -> None:
        seen.append(float(self.distance(u.numpy()).min()))
        plain(self, u, out)

    monkeypatch.setattr(Wall, "add_gradient", watching)
    solve(problem, cases_of())
    assert len(seen) > 10
    assert min(seen) > 0.0


def test_energy_decreases_with_every_newton_step(problem: Problem, device: Device) -> None:
    """Budgets of 1, 2, 3, ... steps give the path; the total potential falls along it."""
    cases, path = cases_of(), [np.zeros((ROWS, len(TOTAL)))]
    path += [solve(problem, cases, Accuracy(tolerance=1e-10, outer=outer)).u for outer in range(1, 12)]
    problem.begin(cases)
    energies = np.array([problem.energy(device.upload(u)) for u in path])
    assert np.isfinite(energies).all()
    change = np.diff(energies, axis=0)
    assert (change <= 1e-12 * np.abs(energies).max()).all()
    assert (change[0, 2:] < 0.0).all()


@pytest.mark.parametrize("law", EVERY_LAW)
def test_converged_outcome_agrees_with_independent_residual(law: str) -> None:
    """The criterion of `Accuracy`, recomputed in NumPy from the results, at several tolerances and precisions."""
    material = tissue(law)
    force = top_forces(MESH, TOTAL)
    precisions: list[tuple[Precision, float]] = [("float64", 1e-4), ("float64", 1e-9), ("float32", 1e-3)]
    for precision, tolerance in precisions:
        accuracy = Accuracy(tolerance=tolerance, precision=precision)
        found = Fem(ANATOMY, [Elasticity(material), Held(), NodalForce()], accuracy, "cpu", element="p1").deform(
            Loads((Nodal(force),))
        )
        assert all(outcome.good for outcome in found.outcome)
        assert not found.displacement[0].any()
        for row in range(2, len(TOTAL)):  # the hair's load drowns in the oracle's own round-off
            internal = internal_forces(MESH, {0: material}, found.displacement[row])
            total = internal - force[row]
            scale = max(np.linalg.norm(internal), np.linalg.norm(force[row]), np.linalg.norm(total[~FREE]))
            free = np.linalg.norm(total[FREE])
            slack = 1.0 + 1e-6 if precision == "float64" else 1.1
            assert free <= slack * tolerance * scale
            if precision == "float64":
                assert found.residual[row] == pytest.approx(free / scale, rel=1e-2, abs=2e-12)


@pytest.mark.parametrize("law", EVERY_LAW)
def test_single_precision_newton_agrees_with_double(law: str) -> None:
    """Within 1e-3 of the largest motion at a tolerance of 1e-4: a factor ten for the condition of the box."""
    effects = Elasticity(tissue(law)), Held(), NodalForce()
    loads = Loads((Nodal(top_forces(MESH, TOTAL[1:])),))
    exact = Fem(ANATOMY, effects, TIGHT, "cpu", element="p1").deform(loads).displacement
    single = Fem(ANATOMY, effects, Accuracy(1e-4, precision="float32"), "cpu", element="p1").deform(loads).displacement
    largest = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(single - exact) / largest).max() < 1e-3


def compressed() -> tuple[Fem, Loads]:
    """A column pressed by 30 % from above: the straight state is a saddle, it buckles."""
    mesh = box((2, 2, 8), 0.1)
    top, base = mesh.nodes[:, 2] > 0.1 - 1e-9, mesh.nodes[:, 2] < 1e-9
    value = np.where(top[:, None], [0.0, 0.0, -0.03], 0.0)
    force = np.zeros_like(value)
    force[~top & ~base, 0] = 1e-6
    fem = Fem(
        hold(mesh, top | base), [Elasticity(), Held(), NodalForce()], Accuracy(tolerance=1e-9), "cpu", element="p1"
    )
    return fem, Loads((Prescribed(value[None]), Nodal(force[None])))


def test_newton_finds_stable_state_after_negative_curvature(device: Device) -> None:
    """The column buckles sideways by millimetres under a negligible load, to a stable state."""
    fem, loads = compressed()
    found = fem.deform(loads)
    assert found.outcome[0].good
    assert np.abs(found.displacement[0, :, 0]).max() > 2e-3
    problem = fem.problem
    problem.begin(Cases(loads, np.zeros(1)))

    def least(u: np.ndarray) -> float:
        problem.linearise(device.upload(u), np.zeros(1, bool))
        free = np.flatnonzero(~fem.anatomy.fixed.ravel())
        K = np.zeros((len(free), len(free)))
        for column, row in enumerate(free):
            p, out = device.upload(np.eye(problem.rows)[:, [row]]), device.allocate(problem.rows, 1)
            problem.add_curvature(p, out)
            K[:, column] = out.numpy()[free, 0]
        return float(np.linalg.eigvalsh(K)[0])

    straight = np.zeros_like(fem.anatomy.mesh.nodes)
    straight[:, 2] = -0.3 * fem.anatomy.mesh.nodes[:, 2]
    assert least(straight.reshape(-1, 1)) < 0.0
    assert least(found.displacement.reshape(-1, 1)) > 0.0


def test_newton_with_block_jacobi_gives_same_result(device: Device) -> None:
    """The preconditioner for meshes that are too large to factorise."""
    effects = Elasticity(), Held(), NodalForce()
    problem = compile_problem(effects, ANATOMY, device)
    cases = cases_of()
    problem.begin(cases)
    jacobi = equilibrium_of(
        problem, NewtonCG(BlockJacobi(device), 400), np.zeros((ROWS, len(TOTAL))), Accuracy(tolerance=1e-9)
    )
    assert all(outcome.good for outcome in jacobi.outcome)
    problem.begin(cases)
    exact = solve(problem, cases)
    np.testing.assert_allclose(jacobi.u, exact.u, atol=1e-6 * np.abs(exact.u).max())
    assert jacobi.linear_iterations > 2 * exact.linear_iterations


class Scaled:
    """A direction of Newton times the numbers (b,) that a function gives of the lengths taken (b,)."""

    def __init__(self, problem: Problem, times: Callable[[np.ndarray], np.ndarray]):
        self.plain, self.times = NewtonCG(build_rest_solver(problem), 400), times

    def begin(self) -> None:
        self.plain.begin()

    def keep(self, device: Device, columns: np.ndarray) -> None:
        self.plain.keep(device, columns)

    def find_direction(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        found = self.plain.find_direction(problem, u, g, gap, forcing, taken)
        return replace(found, d=problem.device.upload(self.times(taken) * found.d.numpy()))


def test_failed_search_is_repeated_with_positive_curvature(problem: Problem, batch: Found) -> None:
    """Every other step fails, the others take the curvature at rest: slower, but convergent."""
    rows = np.array([1, 2, 4])
    problem.begin(select_rows(cases_of(), rows))
    patient = Accuracy(tolerance=1e-7, outer=300)
    uphill = Scaled(problem, lambda taken: np.where(taken == 0.0, 1.0, -1.0))
    found = equilibrium_of(problem, uphill, np.zeros((ROWS, 3)), patient)
    assert all(outcome is Outcome.CONVERGED for outcome in found.outcome)
    assert found.iterations[2] > batch.iterations[4]
    np.testing.assert_allclose(found.u, batch.u[:, rows], atol=1e-6 * np.abs(batch.u).max())


def test_search_that_fails_twice_is_reported_as_stalled(problem: Problem) -> None:
    problem.begin(cases_of())
    uphill = Scaled(problem, lambda taken: np.full(len(taken), -1.0))
    found = equilibrium_of(problem, uphill, np.zeros((ROWS, len(TOTAL))), TIGHT)
    assert all(outcome is Outcome.STALLED for outcome in found.outcome)
    assert not found.u.any()


@pytest.mark.parametrize(("tiny", "outcome"), [(12, Outcome.CONVERGED), (1000, Outcome.STALLED)])
def test_only_many_tiny_steps_end_as_stalled(problem: Problem, batch: Found, tiny: int, outcome: Outcome) -> None:
    """Newton resumes after a few of them, and does not spend its budget on them."""
    problem.begin(select_rows(cases_of(), np.array([4])))
    sizes = chain(repeat(1e-20, tiny), repeat(1.0))
    timid = Scaled(problem, lambda taken: np.full(len(taken), next(sizes)))
    found = equilibrium_of(problem, timid, 0.9 * batch.u[:, [4]], TIGHT)
    assert found.outcome[0] is outcome
    assert found.iterations[0] <= 30


def test_exhausted_budget_is_reported(problem: Problem) -> None:
    found = solve(problem, cases_of(), Accuracy(tolerance=1e-10, outer=1))
    assert found.outcome[-1] is Outcome.BUDGET
    assert found.iterations[-1] == 1
    assert found.residual[-1] > 1e-10
    with pytest.raises(InputError, match="give a whole number from"):
        Accuracy(outer=0)


SPACING = 0.1 / 3
LOST = {
    "mirrored": MESH.nodes * [1.0, 1.0, -1.0],
    "flattened onto a plane": MESH.nodes * [1.0, 1.0, 0.0],
    "flattened sideways": MESH.nodes * [0.0, 1.0, 1.0],
    "scattered": MESH.nodes + 0.5 * SPACING * np.random.default_rng(5).uniform(-1.0, 1.0, MESH.nodes.shape),
}


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("law", ["stable-neo-hookean", "corotational"])
@pytest.mark.parametrize("name", LOST)
def test_unloaded_body_returns_to_rest_without_restart(name: str, law: str, precision: Precision) -> None:
    """Without load, to a millionth of its size. No force is left to scale a residual: that is rest."""
    problem = compile_problem([Elasticity(tissue(law)), Held(), NodalForce()], ANATOMY, find_device("cpu", precision))
    start = np.where(FREE, LOST[name] - MESH.nodes, 0.0).reshape(-1, 1)
    accuracy = Accuracy(tolerance=1e-4, outer=100, precision=precision)
    found = solve(problem, Cases(Loads((Nodal(np.zeros((1, COUNT, 3))),)), np.zeros(1)), accuracy, start)
    assert found.outcome[0] is Outcome.CONVERGED
    assert found.iterations[0] > 1
    assert np.abs(found.u).max() <= 1e-6 * 0.1


def test_round_off_is_reported_and_ends_the_iteration() -> None:
    """A core ten thousand times stiffer: the residual stays above the tolerance; double precision converges."""
    core = np.linalg.norm(MESH.nodes[MESH.tets].mean(axis=1) - [0.033, 0.033, 0.07], axis=1) < 0.03
    mesh = TetMesh(MESH.nodes, MESH.tets, core.astype(int))
    effects = Elasticity(tissue("stable-neo-hookean"), {1: tissue("stable-neo-hookean", 3e7)}), Held(), NodalForce()
    loads = Loads((Nodal(top_forces(MESH, TOTAL[2:5])),))
    single = Fem(base_held(mesh), effects, Accuracy(tolerance=2e-5, precision="float32"), "cpu", element="p1").deform(
        loads
    )
    double = Fem(base_held(mesh), effects, Accuracy(tolerance=2e-5), "cpu", element="p1").deform(loads)
    assert all(outcome is Outcome.ROUND_OFF for outcome in single.outcome)
    assert (single.residual > 2e-5).all()
    assert (single.iterations < 80).all()  # of 260, and no load steps
    assert all(outcome is Outcome.CONVERGED for outcome in double.outcome)
    largest = np.abs(double.displacement).max(axis=(1, 2))
    assert (np.abs(single.displacement - double.displacement).max(axis=(1, 2)) < 2e-2 * largest).all()

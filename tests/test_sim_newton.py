"""The outer iteration on a body with a spring that remembers and a wall: batches, criteria, hard cases."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box, hold, top_forces
from oracle import energy_density, internal_forces
from tiny_terms import Spring, Wall

from sim.accuracy import Accuracy, Precision
from sim.compile import compile_problem
from sim.deformation import Outcome
from sim.device import Device, find_device
from sim.direction import NewtonCG
from sim.effects import Elasticity, Held, NodalForce, ToolForce
from sim.errors import InputError
from sim.fem import Fem, choose_preconditioner
from sim.linear import BlockJacobi
from sim.loads import Loads, Nodal, Prescribed, Pushed
from sim.material import LAWS, Material
from sim.newton import Equilibrium, find_equilibrium
from sim.problem import Problem
from sim.term import Cases

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
COUNT, ROWS = len(MESH.nodes), MESH.nodes.size
FREE = ~ANATOMY.held
CEILING = 0.102
TIGHT = Accuracy(tolerance=1e-10)


def problem_of(device: Device, law: str = "stable-neo-hookean") -> Problem:
    """Elasticity, nodal forces, a spring with history, and a wall 2 mm above the body."""
    material = Material(law, 3000.0, 0.45)
    plain = compile_problem([Elasticity(material), Held(), NodalForce()], ANATOMY, device)
    extra = Spring(device, ROWS, 0.5), Wall(device, MESH.nodes, CEILING, 1.5e-3, 1e4)
    return Problem((*plain.terms, *extra), plain.constraint, device, plain.impose)


# From nothing through a hair to a press, and pulls into the wall: they are done at different steps.
TOTAL = np.array(
    [[0, 0, 0], [0, 0, -1e-7], [0.01, 0, -0.02], [0, 0, 0.3], [0.2, 0.1, -0.4], [0, 0, 2.0], [0.6, 0, -0.9]]
)


def cases_of(total: np.ndarray = TOTAL, time: float = 0.7) -> Cases:
    count = len(total)
    history = 2e-4 * np.random.default_rng(3).normal(size=(len(TOTAL), COUNT, 3))[:count]
    loads = Loads((Nodal(top_forces(MESH, total)),), np.full(count, time))
    return Cases(loads, np.zeros(count), {"spring": history})


def rows_of(cases: Cases, index: np.ndarray) -> Cases:
    history = {name: value[index] for name, value in cases.history.items()}
    return Cases(cases.loads.rows(index), cases.start_time[index], history)


def solve(problem: Problem, cases: Cases, accuracy: Accuracy = TIGHT, start: np.ndarray | None = None) -> Equilibrium:
    problem.begin(cases)
    direction = NewtonCG(choose_preconditioner(problem), accuracy.inner)
    guess = np.zeros((ROWS, len(cases.loads))) if start is None else start
    return find_equilibrium(problem, direction, guess, accuracy)


@pytest.fixture(scope="module")
def device() -> Device:
    return find_device("cpu", "float64")


@pytest.fixture(scope="module")
def problem(device: Device) -> Problem:
    return problem_of(device)


@pytest.fixture(scope="module")
def batch(problem: Problem) -> Equilibrium:
    return solve(problem, cases_of())


def test_the_cases_leave_at_different_steps(batch: Equilibrium) -> None:
    """Otherwise the tests below prove nothing."""
    assert all(outcome is Outcome.CONVERGED for outcome in batch.outcome)
    assert len(set(batch.iterations)) >= 4


def test_a_batch_is_its_rows_one_by_one(problem: Problem, batch: Equilibrium) -> None:
    for row in range(len(TOTAL)):
        alone = solve(problem, rows_of(cases_of(), np.array([row])))
        np.testing.assert_allclose(alone.u[:, 0], batch.u[:, row], atol=1e-8 * max(np.abs(batch.u[:, row]).max(), 1e-3))
        assert alone.iterations[0] == batch.iterations[row]


def test_rows_do_not_depend_on_their_order(problem: Problem, batch: Equilibrium) -> None:
    order = np.array([5, 0, 6, 2, 1, 4, 3])
    shuffled = solve(problem, rows_of(cases_of(), order))
    np.testing.assert_allclose(shuffled.u, batch.u[:, order], atol=1e-10)


def test_history_arrives_in_its_rows(problem: Problem, batch: Equilibrium, device: Device) -> None:
    cases = cases_of()
    problem.begin(cases)
    history = problem.end(device.array(batch.u))
    assert list(history) == ["spring"]
    before, u = cases.history["spring"], batch.u.T.reshape(len(TOTAL), COUNT, 3)
    np.testing.assert_allclose(history["spring"], before + (1.0 - np.exp(-0.7)) * (u - before), atol=1e-14)


def test_history_travels_through_the_deformer() -> None:
    """Spring that creeps: with each call the body sinks further, as the same steps one by one in a batch of its own."""
    fem = Fem(ANATOMY, [Elasticity(), Held(), NodalForce()], TIGHT, "cpu", batch=2)
    fem.problem = Problem(
        (*fem.problem.terms, Spring(fem.problem.device, ROWS, 40.0)), fem.problem.constraint, fem.problem.device
    )
    total = np.array([[0.0, 0.0, -0.1], [0.05, 0.0, 0.02], [0.0, 0.0, -0.3]])

    def walk(rows: np.ndarray) -> list[np.ndarray]:
        state, path, anchor, begun = None, [], np.zeros((len(rows), COUNT, 3)), 0.0
        for time in (0.5, 1.0, 3.0):
            loads = Loads((Nodal(top_forces(MESH, total[rows])),), np.full(len(rows), time))
            state = fem.deform(loads, state)
            anchor += (1.0 - np.exp(begun - time)) * (state.displacement - anchor)
            np.testing.assert_allclose(state.history["spring"], anchor, atol=1e-14)
            begun = time
            path.append(state.displacement)
        return path

    together = walk(np.arange(3))
    depth = [-state[0, :, 2].min() for state in together]
    assert depth[0] < depth[1] < depth[2]
    for row in range(3):
        for whole, alone in zip(together, walk(np.array([row])), strict=True):
            np.testing.assert_allclose(alone[0], whole[row], atol=1e-10)


def test_the_wall_is_never_crossed(problem: Problem, batch: Equilibrium, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by the answers, and not on the way: every state that the gradient sees lies below it."""
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


def test_energy_decreases_with_every_step(problem: Problem, device: Device) -> None:
    """Budgets of 1, 2, 3, ... steps give the path; the total potential falls along it."""
    cases, path = cases_of(), [np.zeros((ROWS, len(TOTAL)))]
    path += [solve(problem, cases, Accuracy(tolerance=1e-10, outer=outer)).u for outer in range(1, 12)]
    problem.begin(cases)
    energies = np.array([problem.energy(device.array(u)) for u in path])
    assert np.isfinite(energies).all()
    change = np.diff(energies, axis=0)
    assert (change <= 1e-12 * np.abs(energies).max()).all()
    assert (change[0, 2:] < 0.0).all()


@pytest.mark.parametrize("law", LAWS)
def test_converged_means_converged_by_an_independent_residual(law: str) -> None:
    """The criterion of `Accuracy`, recomputed in NumPy from the answers alone, at several tolerances and precisions."""
    material = Material(law, 3000.0, 0.45)
    force = top_forces(MESH, TOTAL)
    precisions: list[tuple[Precision, float]] = [("float64", 1e-4), ("float64", 1e-9), ("float32", 1e-3)]
    for precision, tolerance in precisions:
        accuracy = Accuracy(tolerance=tolerance, precision=precision)
        found = Fem(ANATOMY, [Elasticity(material), Held(), NodalForce()], accuracy, "cpu").deform(
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


@pytest.mark.parametrize("law", LAWS)
def test_single_precision_agrees_with_double(law: str) -> None:
    """Within 1e-3 of the largest motion at a tolerance of 1e-4: a factor ten for the condition of the box."""
    effects = Elasticity(Material(law, 3000.0, 0.45)), Held(), NodalForce()
    loads = Loads((Nodal(top_forces(MESH, TOTAL[1:])),))
    exact = Fem(ANATOMY, effects, TIGHT, "cpu").deform(loads).displacement
    single = Fem(ANATOMY, effects, Accuracy(1e-4, precision="float32"), "cpu").deform(loads).displacement
    largest = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(single - exact) / largest).max() < 1e-3


def compressed() -> tuple[Fem, Loads]:
    """A column pressed by 30 % from above: the straight state is a saddle, it buckles."""
    mesh = box((2, 2, 8), 0.1)
    top, base = mesh.nodes[:, 2] > 0.1 - 1e-9, mesh.nodes[:, 2] < 1e-9
    value = np.where(top[:, None], [0.0, 0.0, -0.03], 0.0)
    force = np.zeros_like(value)
    force[~top & ~base, 0] = 1e-6
    fem = Fem(hold(mesh, top | base), [Elasticity(), Held(), NodalForce()], Accuracy(tolerance=1e-9), "cpu")
    return fem, Loads((Prescribed(value[None]), Nodal(force[None])))


def test_negative_curvature_is_met_and_left(device: Device) -> None:
    """The column buckles sideways by millimetres under a load of nothing, to a stable state."""
    fem, loads = compressed()
    found = fem.deform(loads)
    assert found.outcome[0].good
    assert np.abs(found.displacement[0, :, 0]).max() > 2e-3
    problem = fem.problem
    problem.begin(Cases(loads, np.zeros(1)))

    def least(u: np.ndarray) -> float:
        problem.linearise(device.array(u), np.zeros(1, bool))
        free = np.flatnonzero(~fem.anatomy.held.ravel())
        K = np.zeros((len(free), len(free)))
        for column, row in enumerate(free):
            p, out = device.array(np.eye(problem.rows)[:, [row]]), device.zeros(problem.rows, 1)
            problem.add_curvature(p, out)
            K[:, column] = out.numpy()[free, 0]
        return float(np.linalg.eigvalsh(K)[0])

    straight = np.zeros_like(fem.anatomy.mesh.nodes)
    straight[:, 2] = -0.3 * fem.anatomy.mesh.nodes[:, 2]
    assert least(straight.reshape(-1, 1)) < 0.0
    assert least(found.displacement.reshape(-1, 1)) > 0.0


def test_block_jacobi_reaches_the_same_answer(device: Device) -> None:
    """What meshes too large to factorise use."""
    effects = Elasticity(), Held(), NodalForce()
    problem = compile_problem(effects, ANATOMY, device)
    cases = cases_of()
    problem.begin(cases)
    jacobi = find_equilibrium(
        problem, NewtonCG(BlockJacobi(device), 400), np.zeros((ROWS, len(TOTAL))), Accuracy(tolerance=1e-9)
    )
    assert all(outcome.good for outcome in jacobi.outcome)
    problem.begin(cases)
    exact = solve(problem, cases)
    np.testing.assert_allclose(jacobi.u, exact.u, atol=1e-6 * np.abs(exact.u).max())
    assert jacobi.linear_iterations > 2 * exact.linear_iterations


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the kernels launched."""
    names: list[str] = []
    plain = wp.launch

    def counting(kernel: wp.Kernel, *arguments: object, **named: object) -> object:
        names.append(kernel.key)
        return plain(kernel, *arguments, **named)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(wp, "launch", counting)
    yield names


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_sixty_four_loads_launch_as_many_kernels_as_one(launches: list[str], precision: Precision) -> None:
    """Identical loads take the same iterations, so that the whole solves can be compared launch by launch."""
    accuracy = Accuracy(tolerance=1e-4, precision=precision)
    fem = Fem(ANATOMY, [Elasticity(), Held(), ToolForce(), NodalForce()], accuracy, "cpu", batch=64)

    def solved(count: int) -> tuple[list[str], np.ndarray]:
        launches.clear()
        push = Pushed(*(np.repeat(x, count, axis=0) for x in ([[0.03, 0.03, 0.1]], [[0.1, 0.0, -0.3]], [0.02])))
        found = fem.deform(Loads((push, Nodal(top_forces(MESH, np.repeat([[0.1, 0.2, 0.0]], count, axis=0))))))
        return list(launches), found.iterations

    one, iterations = solved(1)
    many, together = solved(64)
    assert iterations[0] >= 3
    assert (together == iterations[0]).all()
    assert many == one


def test_only_what_is_asked_for_is_imported() -> None:
    """In a fresh interpreter: laws, terms and libraries that a scene does not name stay out of memory."""
    script = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "import numpy as np\n"
        "from boxes import base_held, box, top_forces\n"
        "from sim.effects import Elasticity, Held, NodalForce\n"
        "from sim.fem import Fem\n"
        "from sim.loads import Loads, Nodal\n"
        "from sim.material import Material\n"
        "mesh = box((1, 1, 1))\n"
        "effects = [Elasticity(Material('linear', 3000.0, 0.3)), Held(){more}]\n"
        "fem = Fem(base_held(mesh), effects, device='cpu')\n"
        "print(*sorted(name for name in sys.modules if name.startswith('sim.terms.')))\n"
        "print(*sorted({{name.split('.')[0] for name in sys.modules}} & {{'torch', 'meshio', 'trimesh', 'nibabel', "
        "'nilearn', 'viser', 'cv2', 'sklearn', 'surrogate', 'scenes', 'ar'}}))\n"
    )

    def imported(more: str) -> list[str]:
        run = subprocess.run(
            [sys.executable, "-c", script.format(more=more)], capture_output=True, text=True, check=True, timeout=120
        )
        terms, libraries = run.stdout.split("\n")[:2]
        assert libraries == ""
        return [name.removeprefix("sim.terms.") for name in terms.split()]

    assert imported("") == ["elasticity", "invariants", "law", "linear"]
    assert imported(", NodalForce()") == ["dead_force", "elasticity", "invariants", "law", "linear"]


def test_an_effect_that_is_not_asked_for_is_not_launched(launches: list[str]) -> None:
    fem = Fem(ANATOMY, [Elasticity(), Held()], TIGHT, "cpu")
    value = np.where(ANATOMY.held, 1e-3, 0.0)[None]
    fem.deform(Loads((Prescribed(value),)))
    names = {name.split("__")[0] for name in launches}
    assert "average" not in names  # no footprint is moved
    assert "bound_step" not in names  # the stable law has no domain to stay in
    assert any("add_gradient" in name for name in launches)


def test_a_spent_budget_is_told(problem: Problem) -> None:
    found = solve(problem, cases_of(), Accuracy(tolerance=1e-10, outer=1))
    assert found.outcome[-1] is Outcome.BUDGET
    assert found.iterations[-1] == 1
    assert found.residual[-1] > 1e-10
    with pytest.raises(InputError, match="allow no work"):
        Accuracy(outer=0)


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        ([Held(), NodalForce()], "no effect resists deformation"),
        ([Elasticity(), Elasticity(), Held()], "Elasticity is asked for 2 times"),
        ([Elasticity(), Held(), "gravity"], "no effect is called str: choose from Elasticity"),
        (
            [Elasticity(regions={4: Material("linear", 1.0, 0.0)}), Held()],
            r"region 4, but the mesh has the regions \[0",
        ),
        ([Elasticity(default=None), Held()], "region 0 has no tissue law"),
        ([Elasticity(), NodalForce()], "can move rigidly"),
    ],
)
def test_effects_that_make_no_problem_are_refused(device: Device, effects: list, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        compile_problem(effects, ANATOMY, device)


def test_the_potential_is_the_sum_of_its_terms(problem: Problem, device: Device) -> None:
    u = 1e-3 * np.random.default_rng(9).normal(size=(ROWS, len(TOTAL)))
    cases = cases_of()
    problem.begin(cases)
    parts = []
    for term in problem.terms:
        out = wp.zeros(len(TOTAL), dtype=wp.float64, device="cpu")
        term.energy(device.array(u), out)
        parts.append(out.numpy())
    np.testing.assert_allclose(problem.energy(device.array(u)), np.sum(parts, axis=0), rtol=1e-13)
    X = MESH.nodes[MESH.tets]
    rest = np.swapaxes(X[:, 1:] - X[:, :1], 1, 2)
    psi = partial(energy_density, "stable-neo-hookean", mu=problem_lame()[0], lam=problem_lame()[1])
    for column in range(len(TOTAL)):
        x = X + u[:, column].reshape(-1, 3)[MESH.tets]
        F = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) @ np.linalg.inv(rest)
        assert parts[0][column] == pytest.approx((MESH.volumes * psi(F)).sum(), rel=1e-10)


def problem_lame() -> tuple[float, float]:
    return Material("stable-neo-hookean", 3000.0, 0.45).lame

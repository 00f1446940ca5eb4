"""Nonlinear elimination near the opening: fewer looks at the whole body, each column by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from openings import EFFECTS, FINE, LAWS_AND_ELEMENTS, TOTAL, begun, body, descent_of, equilibria, loads_of
from oracle import tissue

from scenes.script.shipped_files import get_template_path
from sim.accuracy import TRAIN, Accuracy
from sim.bodies.meshfile import read_anatomy
from sim.compile import compile_part, compile_problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.fem import Fem
from sim.linalg.preconditioner import build_rest_solver
from sim.linalg.schur import condense_exterior
from sim.local_solvers.batch_elimination import BatchElimination, build_batch_elimination, find_near_tetrahedra
from sim.local_solvers.outer_loop import CycleLimits
from sim.minimisers.lbfgs_kernels import DONE, LIVE, NOT_FINITE
from sim.runtime.device import find_device
from sim.strategy.plan import SolverStep
from sim.terms.schur_stiffness import Exterior
from surrogate.data.tool_loads import draw

LAW = "stable-neo-hookean"
STEP = "_run_cycle"
"""Method that takes a cycle's correction."""


def test_on_a_brain_broad_pushes_take_few_looks_at_the_whole() -> None:
    anatomy = read_anatomy(get_template_path())
    effects = (Elasticity(), Held(), Slide(), ToolForce())
    fem, loads = Fem(anatomy, effects, TRAIN, "cpu", element="p1"), draw("spatula", anatomy, 3, 1)
    near = build_batch_elimination(fem.problem, build_rest_solver(fem.problem), effects, fem.space)
    assert near is not None and 0.1 < len(near.rows) / fem.problem.rows < 0.3
    fem.problem.begin(Cases(loads, np.zeros(3)))
    rest, tolerance = fem.problem.device.allocate(fem.problem.rows, 3), np.full(3, TRAIN.tolerance)
    found = near.descend(rest, tolerance, 100)
    plain = fem.deform(loads)
    assert (found.status == DONE).all() and all(outcome.good for outcome in plain.outcome)
    assert np.median(found.steps) <= 0.4 * np.median(plain.iterations)
    expected = plain.displacement.reshape(3, -1).T
    np.testing.assert_allclose(found.u.numpy(), expected, atol=1e-3 * np.abs(expected).max())


def test_columns_go_each_by_itself() -> None:
    problem, space = begun(LAW)
    elimination = descent_of(build_batch_elimination, problem, space, LAW)
    together = elimination.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), 1e-5), 100)
    for row in range(len(TOTAL)):
        problem.begin(Cases(loads_of(TOTAL[[row]]), np.zeros(1)))
        alone = elimination.descend(problem.device.allocate(problem.rows, 1), np.full(1, 1e-5), 100)
        assert alone.steps[0] == together.steps[row]
        np.testing.assert_allclose(alone.u.numpy()[:, 0], together.u.numpy()[:, row], atol=1e-10)


def test_the_budget_leaves_the_last_finite_state_and_says_so() -> None:
    problem, space = begun(LAW)
    elimination = descent_of(build_batch_elimination, problem, space, LAW)
    start = problem.device.allocate(problem.rows, len(TOTAL)).numpy()
    start[:, 1] = np.nan
    found = elimination.descend(problem.device.upload(start), np.full(len(TOTAL), 1e-12), 1)
    np.testing.assert_array_equal(found.status, [LIVE, NOT_FINITE, LIVE, LIVE, DONE])
    good = [0, 2, 3]
    problem.begin(Cases(loads_of(TOTAL[good]), np.zeros(3)))
    _, free, scale = problem.residual(problem.device.upload(found.u.numpy()[:, good]))
    np.testing.assert_allclose(found.residual[good], free / scale, rtol=1e-6)
    np.testing.assert_array_equal(found.left, good)


def test_rounding_of_what_follows_leaves_no_plane() -> None:
    problem, space = begun(LAW)
    elimination, random = descent_of(build_batch_elimination, problem, space, LAW), np.random.default_rng(0)

    def rounded(x: wp.array, out: wp.array) -> None:
        elimination.follow(x, out)
        out.assign(out.numpy() + 1e-6 * random.normal(size=out.shape))

    rough = replace(elimination, follow=rounded)
    found = rough.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), 1e-5), 1)
    assert found.u.numpy()[:, :4].any(axis=0).all()
    assert not problem.compute_gap(found.u)[1].any()


def test_the_condensed_surroundings_are_the_schur_complement() -> None:
    problem, space = begun("linear", "smoothed")
    chosen = find_near_tetrahedra(space, problem.constraint)
    assert chosen is not None and 0.15 < chosen.mean() < 0.25
    nodes = np.unique(space.table[chosen])
    own = compile_part((Elasticity(tissue("linear")), *EFFECTS), space, problem, chosen, nodes)
    around = condense_exterior(problem, nodes, own.rest_curvature())
    basis, whole = problem.constraint.build_basis(), problem.rest_curvature().toarray()
    part = (3 * nodes[:, None] + np.arange(3)).ravel()
    stays = np.ones(problem.rows, bool)
    stays[part] = False
    far = basis.toarray()[:, np.abs(basis.toarray()[stays]).max(axis=0) > 0.0]
    moved = -far @ np.linalg.solve(far.T @ whole @ far, far.T @ whole[:, part])
    schur = whole[np.ix_(part, part)] + whole[part] @ moved - own.rest_curvature().toarray()
    expected = np.zeros_like(schur)
    expected[np.ix_(around.rows, around.rows)] = around.stiffness
    np.testing.assert_allclose(expected, schur, atol=1e-6 * np.abs(whole).max())
    np.testing.assert_allclose(around.follow, moved[:, around.rows], atol=1e-5)


def test_batch_solver_passes_on_unconverged_columns() -> None:
    anatomy, space = body()
    effects = (Elasticity(tissue("stable-neo-hookean")), *EFFECTS)
    fem, without = (
        Fem(anatomy, effects, Accuracy(FINE), "cpu", None, "p1", False, out) for out in ((), (SolverStep.NEAR,))
    )
    many = np.repeat(TOTAL, 4, axis=0)
    plain = without.deform(loads_of(many))
    near = build_batch_elimination(fem.problem, build_rest_solver(fem.problem), effects, space)
    assert near is not None
    for cycles in (12, 3):
        some = replace(near, limits=CycleLimits(cycles=cycles))
        fem.strategy = replace(fem.strategy, near=lambda some=some: some)
        found = fem.deform(loads_of(many))
        assert all(outcome.good for outcome in found.outcome)
        assert (found.iterations != plain.iterations).any()
        assert all(len(value) == len(many) for value in found.memory.values())
        largest = np.abs(plain.displacement).max()
        np.testing.assert_allclose(found.displacement, plain.displacement, atol=1e-5 * largest)


def test_the_surroundings_are_a_potential() -> None:
    device, random = find_device("cpu", "float64"), np.random.default_rng(0)
    root, rows = random.normal(size=(4, 4)), np.array([1, 2, 5, 7])
    exterior = Exterior(rows, root @ root.T, 9, device)
    u, d = random.normal(size=(2, 9, 3))
    out, energy = device.allocate(9, 3), [wp.zeros(3, dtype=wp.float64, device=device.name) for _ in range(2)]
    exterior.add_gradient(device.upload(u), out)
    np.testing.assert_allclose(out.numpy(), exterior.rest_curvature() @ u, atol=1e-12)
    for value, at in zip(energy, (u + d, u - d), strict=True):
        exterior.energy(device.upload(at), value)
    rise = energy[0].numpy() - energy[1].numpy()
    np.testing.assert_allclose(rise, 2.0 * (out.numpy() * d).sum(axis=0), rtol=1e-12)


def larger(force: wp.array, factor: float) -> wp.array:
    return wp.array(factor * force.numpy().astype(np.float64), dtype=force.dtype, device=force.device)


@LAWS_AND_ELEMENTS
def test_it_ends_where_the_whole_does(law: str, element: str) -> None:
    problem, space = begun(law, element)
    descent, expected = descent_of(build_batch_elimination, problem, space, law), equilibria(problem)
    problem.begin(Cases(loads_of(TOTAL), np.zeros(len(TOTAL))))
    found = descent.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), FINE), 100)
    assert (found.status == DONE).all() and (found.residual <= FINE).all()
    np.testing.assert_allclose(found.u.numpy(), expected, atol=1e-5 * np.abs(expected).max())
    assert found.steps[-1] == 0 and not found.u.numpy()[:, -1].any()


@pytest.mark.parametrize("factor", [1e3, 1e12, 1e30])
def test_a_cycle_that_explodes_is_not_taken(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Forces so large that they overflow, or that what is free of them looks small beside the rest."""
    anatomy, space = body()
    problem = compile_problem((Elasticity(tissue(LAW)), *EFFECTS), anatomy, find_device("cpu", "float32"), space)
    problem.begin(Cases(loads_of(TOTAL[:4]), np.zeros(4)))
    descent, inside = descent_of(build_batch_elimination, problem, space, LAW), getattr(BatchElimination, STEP)
    monkeypatch.setattr(BatchElimination, STEP, lambda *args: larger(inside(*args), factor))
    found = descent.descend(problem.device.allocate(problem.rows, 4), np.full(4, 1e-4), 100)
    assert (found.status == LIVE).all() and not found.u.numpy().any()
    np.testing.assert_allclose(found.residual, 1.0)


def test_what_gets_no_nearer_is_left_to_others() -> None:
    problem, space = begun(LAW, total=TOTAL[:1])
    found = descent_of(build_batch_elimination, problem, space, LAW).descend(
        problem.device.allocate(problem.rows, 1), np.zeros(1), 100
    )
    assert found.status[0] == LIVE and found.residual[0] < 1e-12
    assert found.steps[0] <= CycleLimits().cycles and found.steps[0] < 20 + CycleLimits().patience

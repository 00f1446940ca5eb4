"""Nonlinear elimination near the opening: fewer residuals of the whole body, independent columns."""

from dataclasses import replace

import numpy as np
import warp as wp
from openings import FINE, LAWS_AND_ELEMENTS, TOTAL, begun, descent_of, equilibria, loads_of

from scenes.script.shipped_files import get_template_path
from sim.accuracy import TRAIN
from sim.bodies.meshfile import read_anatomy
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.fem import Fem
from sim.linalg.preconditioner import build_rest_solver
from sim.local_solvers.batch_elimination import build_batch_elimination
from sim.minimisers.lbfgs_kernels import DONE, LIVE, NOT_FINITE
from surrogate.data.tool_loads import draw

LAW = "stable-neo-hookean"
"""Method that takes a cycle's correction."""


def test_elimination_needs_fewer_global_steps_on_brain() -> None:
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


def test_elimination_columns_are_independent() -> None:
    problem, space = begun(LAW)
    elimination = descent_of(build_batch_elimination, problem, space, LAW)
    together = elimination.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), 1e-5), 100)
    for row in range(len(TOTAL)):
        problem.begin(Cases(loads_of(TOTAL[[row]]), np.zeros(1)))
        alone = elimination.descend(problem.device.allocate(problem.rows, 1), np.full(1, 1e-5), 100)
        assert alone.steps[0] == together.steps[row]
        np.testing.assert_allclose(alone.u.numpy()[:, 0], together.u.numpy()[:, row], atol=1e-10)


def test_elimination_out_of_budget_keeps_last_finite_state() -> None:
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
    np.testing.assert_array_equal(found.unfinished_cases, good)


def test_rounding_in_elimination_violates_no_constraint() -> None:
    problem, space = begun(LAW)
    elimination, random = descent_of(build_batch_elimination, problem, space, LAW), np.random.default_rng(0)

    def rounded(x: wp.array, out: wp.array) -> None:
        elimination.extend_motion(x, out)
        out.assign(out.numpy() + 1e-6 * random.normal(size=out.shape))

    rough = replace(elimination, extend_motion=rounded)
    found = rough.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), 1e-5), 1)
    assert found.u.numpy()[:, :4].any(axis=0).all()
    assert not problem.compute_gap(found.u)[1].any()


@LAWS_AND_ELEMENTS
def test_elimination_agrees_with_equilibrium_of_whole_body(law: str, element: str) -> None:
    problem, space = begun(law, element)
    descent, expected = descent_of(build_batch_elimination, problem, space, law), equilibria(problem)
    problem.begin(Cases(loads_of(TOTAL), np.zeros(len(TOTAL))))
    found = descent.descend(problem.device.allocate(problem.rows, len(TOTAL)), np.full(len(TOTAL), FINE), 100)
    assert (found.status == DONE).all() and (found.residual <= FINE).all()
    np.testing.assert_allclose(found.u.numpy(), expected, atol=1e-5 * np.abs(expected).max())
    assert found.steps[-1] == 0 and not found.u.numpy()[:, -1].any()

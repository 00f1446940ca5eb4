"""Elimination of a clamped part against L-BFGS and Newton on the whole body."""

import numpy as np
import pytest
from boxes import base_held, box
from oracle import EVERY_LAW, tissue

from sim.accuracy import Accuracy
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, ToolForce
from sim.fem import Fem
from sim.loads import Loads, push
from sim.local_solvers.clamped_elimination import ClampedElimination
from sim.minimisers.lbfgs_kernels import DONE, LIVE
from sim.strategy.plan import SolverStep
from sim.terms.elasticity import ElasticTerm

BODY = base_held(box((4, 4, 4), 0.1))
EFFECTS = (Elasticity(tissue("stable-neo-hookean")), Held(), ToolForce())


def pressed(down: float) -> Loads:
    return push(np.array([0.05, 0.05, 0.1]), np.array([0.3 * down, 0.0, -down]), 0.02)


def fem_and_elimination() -> tuple[Fem, ClampedElimination]:
    fem = Fem(BODY, EFFECTS, Accuracy(1e-8), "cpu", element="p2")
    return fem, ClampedElimination(fem.problem, fem.strategy.preconditioner, EFFECTS, fem.space)


def test_clamped_elimination_finds_equilibrium() -> None:
    """Under a force that compresses a box by a twentieth of its height."""
    fem, elimination = fem_and_elimination()
    load = pressed(0.6)
    answer = fem.deform(load)
    expected = Fem(BODY, EFFECTS, Accuracy(1e-8), "cpu", element="p2", avoid=(SolverStep.CLAMPED,)).deform(load)
    moved = np.abs(expected.displacement).max()
    assert answer.outcome[0].good and moved > 5e-3
    np.testing.assert_allclose(answer.displacement, expected.displacement, atol=1e-5 * moved)
    fem.problem.begin(Cases(load, np.zeros(1)))
    found = elimination.descend(fem.problem.device.allocate(fem.problem.rows, 1), np.array([1e-8]), 60)
    assert found.status[0] == DONE and found.steps[0] > 0
    assert fem.problem.residual(found.u)[1][0] <= 1.01e-8 * fem.problem.residual(found.u)[2][0]


def test_clamped_elimination_out_of_budget_lowers_residual() -> None:
    fem, elimination = fem_and_elimination()
    fem.problem.begin(Cases(pressed(0.6), np.zeros(1)))
    start = fem.problem.device.allocate(fem.problem.rows, 1)
    found = elimination.descend(start, np.array([1e-8]), 3)
    assert found.status[0] == LIVE and found.steps[0] == 3
    before, after = (fem.problem.residual(u)[1][0] for u in (start, found.u))
    assert after < 0.5 * before


def test_clamped_elimination_skips_small_strain() -> None:
    fem, elimination = fem_and_elimination()
    fem.problem.begin(Cases(pressed(1e-3), np.zeros(1)))
    found = elimination.descend(fem.problem.device.allocate(fem.problem.rows, 1), np.array([1e-8]), 60)
    assert found.status[0] == LIVE and found.steps[0] == 0 and not found.u.numpy().any()
    assert fem.deform(pressed(1e-3)).outcome[0].good


@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("element", ["p2", "smoothed"])
def test_assembled_curvature_agrees_with_curvature_product(law: str, element: str) -> None:
    fem = Fem(BODY, (Elasticity(tissue(law)), Held(), ToolForce()), Accuracy(1e-8), "cpu", element=element)
    problem, random = fem.problem, np.random.default_rng(0)
    u, p = (problem.device.upload(scale * random.normal(size=(problem.rows, 1))) for scale in (3e-4, 1.0))
    problem.linearise(u, np.zeros(1, bool))
    expected = problem.device.allocate(problem.rows, 1)
    problem.add_curvature(p, expected)
    found = sum(term.assemble_stiffness() @ p.numpy() for term in problem.terms if isinstance(term, ElasticTerm))
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-10 * np.abs(expected.numpy()).max())


@pytest.mark.parametrize("law", ["neo-hookean", "ogden"])
@pytest.mark.parametrize(("down", "aside"), [(2.0, 1.0), (2.0, 6.0)])
def test_clamped_elimination_solves_laws_without_inversion(law: str, down: float, aside: float) -> None:
    body = base_held(box((3, 3, 3), 0.1))
    load = push(np.array([0.05, 0.05, 0.1]), np.array([aside, 0.0, -down]), 0.02)
    effects = (Elasticity(tissue(law)), Held(), ToolForce())
    answer, expected = (
        Fem(body, effects, Accuracy(1e-6, limit_strain=False), "cpu", element="p2", avoid=avoid).deform(load)
        for avoid in ((), (SolverStep.CLAMPED,))
    )
    assert answer.outcome[0].good and expected.outcome[0].good and answer.inverted[0] == 0
    moved = np.abs(expected.displacement).max()
    np.testing.assert_allclose(answer.displacement, expected.displacement, atol=1e-4 * moved)

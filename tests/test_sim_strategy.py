"""Fallbacks of failed solutions, and the state that an unsolvable case returns."""

from dataclasses import replace

import numpy as np
import openings
import pytest
from boxes import base_held, box, top_forces
from oracle import internal_forces, tissue

from sim.accuracy import DRAFT, Accuracy
from sim.deformation import Deformation, Outcome, build_start
from sim.effects import Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.loads import Loads, Nodal

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
FREE = ~ANATOMY.fixed
ACCURACY = Accuracy(tolerance=1e-8)
# Easy, hopeless in so few steps, easy, nothing, and hard enough for load steps.
TOTAL = np.array([[0.0, 0.0, -0.1], [0.0, 0.0, -40.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.9]])
HASTY = replace(ACCURACY, outer=6)
CRUSHED = np.where(FREE, MESH.nodes * [0.0, 0.0, -1.5], 0.0)


def fem(accuracy: Accuracy = ACCURACY, law: str = "stable-neo-hookean") -> Fem:
    return Fem(ANATOMY, [Elasticity(tissue(law)), Held(), NodalForce()], accuracy, "cpu", element="p1")


def loads(total: np.ndarray = TOTAL) -> Loads:
    return Loads((Nodal(top_forces(MESH, total)),))


def residual(found: Deformation, row: int, share: float = 1.0) -> float:
    force = share * top_forces(MESH, TOTAL[row])[0]
    inner = internal_forces(MESH, {0: tissue("stable-neo-hookean")}, found.displacement[row])
    return float(np.linalg.norm((inner - force)[FREE]) / np.linalg.norm(inner))


@pytest.fixture(scope="module")
def hasty() -> Deformation:
    return fem(HASTY).deform(loads())


def test_each_case_ends_with_its_expected_outcome(hasty: Deformation) -> None:
    assert hasty.outcome == (
        Outcome.CONVERGED, Outcome.BUDGET, Outcome.CONVERGED, Outcome.CONVERGED, Outcome.CONVERGED_IN_STEPS,
    )  # fmt: skip
    np.testing.assert_array_equal(hasty.reached[[0, 2, 3, 4]], 1.0)
    assert 0.0 < hasty.reached[1] < 1.0
    assert hasty.iterations[4] > HASTY.outer
    for row in (0, 2, 4):
        assert residual(hasty, row) <= 1.01e-8


def test_failed_case_is_in_equilibrium_under_its_share(hasty: Deformation) -> None:
    assert residual(hasty, 1, hasty.reached[1]) <= 1.01e-8
    assert hasty.residual[1] == pytest.approx(1.0 - hasty.reached[1], rel=0.2)  # of the load, nobody bears


def test_rows_solved_alone_and_together_agree(hasty: Deformation) -> None:
    for row in range(len(TOTAL)):
        alone = fem(HASTY).deform(loads(TOTAL[[row]]))
        assert alone.outcome[0] is hasty.outcome[row]
        assert alone.reached[0] == hasty.reached[row]
        np.testing.assert_allclose(alone.displacement[0], hasty.displacement[row], atol=1e-8)


def test_accuracy_with_zero_steps_disables_load_steps() -> None:
    found = fem(replace(HASTY, steps=0)).deform(loads())
    assert found.outcome[4] is Outcome.BUDGET
    assert (found.iterations <= HASTY.outer).all()
    np.testing.assert_array_equal(found.reached, [1.0, 0.0, 1.0, 1.0, 0.0])
    assert found.displacement[1].any()  # the last accepted state
    assert DRAFT.steps == 0


@pytest.mark.parametrize("steps", [0, 24])
def test_inverted_start_is_replaced_with_rest(steps: int) -> None:
    """At any cost of the fallback: one row among others."""
    start = np.zeros((5, *MESH.nodes.shape))
    start[[0, 4]] = CRUSHED
    cold = fem(replace(ACCURACY, steps=steps)).deform(loads(TOTAL[[0, 2, 0, 3, 2]]))
    found = fem(replace(ACCURACY, steps=steps)).deform(loads(TOTAL[[0, 2, 0, 3, 2]]), build_start(start))
    assert found.outcome == (Outcome.CONVERGED_ANEW, *[Outcome.CONVERGED] * 3, Outcome.CONVERGED_ANEW)
    assert all(outcome.good for outcome in found.outcome)
    np.testing.assert_array_equal(found.displacement, cold.displacement)


def test_start_that_leads_to_inversion_is_not_used() -> None:
    """Twisted by three quarters of a turn it is not inverted yet; its result is compared with that from rest."""
    twisted = MESH.nodes.copy()
    angle = np.pi * 1.5 * MESH.nodes[:, 2] / MESH.nodes[:, 2].max()
    middle = MESH.nodes[:, :2].mean(axis=0)
    x, y = (MESH.nodes[:, :2] - middle).T
    twisted[:, 0] = middle[0] + np.cos(angle) * x - np.sin(angle) * y
    twisted[:, 1] = middle[1] + np.sin(angle) * x + np.cos(angle) * y
    body = fem()
    found = body.deform(loads(TOTAL[[0]]), build_start(np.where(FREE, twisted - MESH.nodes, 0.0)[None]))
    assert found.outcome[0].good
    assert found.inverted[0] == 0


def test_start_with_inverted_averages_is_replaced_with_rest() -> None:
    effects = (Elasticity(tissue("neo-hookean")), *openings.EFFECTS)
    solver = Fem(openings.body()[0], effects, ACCURACY, "cpu", element="smoothed")
    mesh, load = openings.MESH, openings.loads_of(openings.TOTAL[1:2])
    rest = solver.deform(load)
    found = solver.deform(load, build_start((mesh.nodes * [0.0, 0.0, -1.5])[None]))
    assert found.outcome[0] is Outcome.CONVERGED_ANEW
    np.testing.assert_array_equal(found.displacement, rest.displacement)

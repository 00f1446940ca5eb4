"""Contact solver with factors of the tangent stiffness, against the undeformed stiffness; its warm-start data."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import Accuracy
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.local_solvers.tangent_contact import MAX_STEPS, STATE_KEY
from sim.material import MEASURED_BRAIN, Material, Tissue
from sim.minimisers.lbfgs import DescentResult
from sim.minimisers.lbfgs_kernels import DONE
from sim.tools import Ball

RADIUS, HEIGHT, TOLERANCE = 6e-3, 0.03, 1e-6
LAWS = {"neo-hookean": Material("neo-hookean", 3000.0, 0.45), "brain": MEASURED_BRAIN}


def build_fem(tissue: Tissue, element: str = "smoothed") -> Fem:
    effects = (Elasticity(tissue), Held(), ToolContact((Ball(RADIUS),)))
    return Fem(base_held(box((6, 6, 3), 0.06)), effects, Accuracy(TOLERANCE), "cpu", element=element)


def press(depth: float) -> Cases:
    """A ball in the middle of the box, `depth` below its surface."""
    pose = np.eye(4)
    pose[:3, 3] = (0.031, 0.028, HEIGHT - depth)
    return Cases(Loads((Touching(pose[None, None]),), np.ones(1)), np.zeros(1))


def descend(fem: Fem, depths: tuple[float, ...], tangent: bool) -> list[DescentResult]:
    """Results of both solvers for growing depths, each from the last."""
    u, warm, results = fem.problem.device.allocate(fem.problem.rows, 1), {}, []
    assert fem.strategy.contact is not None and fem.strategy.tangent_contact is not None
    for depth in depths:
        fem.problem.begin(press(depth))
        if tangent:
            found = fem.strategy.tangent_contact.descend(u, np.full(1, TOLERANCE), 200, warm)
        else:
            found = fem.strategy.contact.descend(u, np.full(1, TOLERANCE), 200)
        u, warm = found.u, found.warm_start
        results.append(found)
    return results


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_tangent_contact_agrees_with_the_undeformed_stiffness(law: str, element: str) -> None:
    fem = build_fem(LAWS[law], element)
    results = {tangent: descend(fem, (2e-3, 4e-3), tangent) for tangent in (False, True)}
    for found, expected in zip(results[True], results[False], strict=True):
        assert found.status[0] == expected.status[0] == DONE
        other = expected.u.numpy()
        np.testing.assert_allclose(found.u.numpy(), other, atol=2e-5 * np.abs(other).max())


def test_tangent_contact_converges_where_other_solver_stalls() -> None:
    few, many = (descend(build_fem(MEASURED_BRAIN), (2e-3, 4e-3, 7e-3), tangent)[-1] for tangent in (True, False))
    assert few.status[0] == DONE and many.status[0] != DONE


def count_factors(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    seen, assemble = [], Problem.assemble_stiffness
    monkeypatch.setattr(Problem, "assemble_stiffness", lambda self, u: (seen.append(u), assemble(self, u))[1])
    return seen


def test_next_frame_reuses_the_factor_of_its_warm_start(monkeypatch: pytest.MonkeyPatch) -> None:
    fem = build_fem(MEASURED_BRAIN)
    first, second = (fem.deform(press(depth).loads) for depth in (3e-3, 3.1e-3))
    start = fem.deform(press(3e-3).loads)
    assert STATE_KEY in start.warm and start.warm[STATE_KEY].shape == (1, fem.problem.rows)
    seen = count_factors(monkeypatch)
    found = fem.deform(press(3.1e-3).loads, start)
    assert not seen and found.outcome[0].good and found.iterations[0] <= MAX_STEPS
    np.testing.assert_allclose(found.displacement, second.displacement, atol=1e-4 * np.abs(first.displacement).max())
    # Another solver has no factor yet, computes it from the warm start, and returns the same bits.
    other = build_fem(MEASURED_BRAIN).deform(press(3.1e-3).loads, start)
    assert len(seen) == 1
    np.testing.assert_array_equal(other.displacement, found.displacement)


@pytest.mark.parametrize(
    "warm", [{STATE_KEY: np.zeros((1, 5))}, {STATE_KEY: np.full((1, 588), np.nan, np.float32)}], ids=["size", "nan"]
)
def test_unsuitable_warm_start_is_ignored(warm: Mapping[str, np.ndarray]) -> None:
    fem = build_fem(LAWS["neo-hookean"])
    assert fem.problem.rows == 588 and fem.strategy.tangent_contact is not None
    fem.problem.begin(press(2e-3))
    start = fem.problem.device.allocate(588, 1)
    found, expected = (
        fem.strategy.tangent_contact.descend(start, np.full(1, TOLERANCE), 100, data) for data in (warm, {})
    )
    np.testing.assert_array_equal(found.u.numpy(), expected.u.numpy())


def test_indefinite_tangent_is_replaced_by_undeformed_stiffness(monkeypatch: pytest.MonkeyPatch) -> None:
    fem = build_fem(LAWS["neo-hookean"])
    monkeypatch.setattr(Problem, "assemble_stiffness", lambda self, _: -self.rest_curvature())
    result = fem.deform(press(3e-3).loads)
    monkeypatch.undo()
    assert result.outcome[0].good
    expected = build_fem(LAWS["neo-hookean"]).deform(press(3e-3).loads)
    largest = np.abs(expected.displacement).max()
    np.testing.assert_allclose(result.displacement, expected.displacement, atol=1e-4 * largest)

"""Descent of single loads with the stiffness of strained tissue: result, steps, and data for the next frame."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp
from openings import EFFECTS, FINE, OPENING, TOTAL, begun, body, equilibria, loads_of
from oracle import tissue

from sim.accuracy import LIVE
from sim.deformation import Deformation, Outcome
from sim.discretisation.problem import Problem
from sim.discretisation.space import Discretisation
from sim.effects import Elasticity
from sim.fem import Fem
from sim.linalg.multifrontal import SparseFactor
from sim.linalg.preconditioner import build_rest_solver
from sim.local_solvers.strained_descent import (
    SINGLE_LIMITS,
    UPDATE_KEYS,
    Renewal,
    StiffenedPreconditioner,
    StiffnessUpdate,
    StrainedDescent,
    build_strained_part,
)
from sim.local_solvers.strained_part import StrainLimits
from sim.minimisers.lbfgs import Lbfgs
from sim.minimisers.lbfgs_kernels import DONE, NOT_FINITE
from sim.minimisers.lbfgs_kernels import LIVE as GOING
from sim.strategy.plan import SolverStep

LAW, HARD = "neo-hookean", np.array([[1.0, 0.5, -5.0]])
RENEWAL = Renewal()
EVERY = StrainLimits(min_strain=0.0, max_nodes=10**4, max_candidates=10**4)


def factor_of(problem: Problem) -> SparseFactor:
    found = build_rest_solver(problem)
    assert isinstance(found, SparseFactor)
    return found


def descent_on(
    problem: Problem, space: Discretisation, strains: StrainLimits = SINGLE_LIMITS, renewal: Renewal = RENEWAL
) -> StrainedDescent:
    factor = factor_of(problem)
    return StrainedDescent(problem, factor, build_strained_part(problem, factor, space, strains), renewal)


def hard(element: str = "smoothed") -> tuple[Problem, Discretisation, wp.array]:
    """A hard pull on the opening, and rest."""
    problem, space = begun(LAW, element, HARD)
    return problem, space, problem.device.allocate(problem.rows, 1)


@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_strained_descent_agrees_with_whole_body(element: str) -> None:
    problem, space = begun(LAW, element)
    expected, descent = equilibria(problem), descent_on(problem, space)
    for column, total in enumerate(TOTAL):
        problem, _ = begun(LAW, element, total[None])
        descent = descent_on(problem, space)
        found = descent.descend(problem.device.allocate(problem.rows, 1), np.full(1, FINE), 200)
        assert found.status[0] == DONE and found.residual[0] <= FINE
        np.testing.assert_allclose(found.u.numpy()[:, 0], expected[:, column], atol=1e-5 * np.abs(expected).max())


def test_strained_descent_takes_half_the_steps() -> None:
    problem, space, rest = hard()
    factor, tolerance = factor_of(problem), np.full(1, 1e-6)
    plain = Lbfgs(problem, factor).descend(rest, tolerance, 400)
    found = descent_on(problem, space).descend(rest, tolerance, 400)
    assert found.status[0] == plain.status[0] == DONE
    assert found.steps[0] <= 0.5 * plain.steps[0]


def test_preconditioner_inverts_strained_stiffness(monkeypatch: pytest.MonkeyPatch) -> None:
    """With all nodes it is the inverse of the whole stiffness at the present state."""
    problem, space, rest = hard("p1")
    factor = factor_of(problem)
    bent = descent_on(problem, space).descend(rest, np.full(1, 1e-2), 100).u
    basis, now = problem.constraint.build_basis(), problem.assemble_stiffness(bent)
    force = basis @ np.random.default_rng(0).normal(size=(basis.shape[1], 1))
    exact = basis @ sp.linalg.spsolve(sp.csc_array(basis.T @ now @ basis), basis.T @ force)
    at_rest = basis @ sp.linalg.spsolve(sp.csc_array(basis.T @ problem.rest_curvature() @ basis), basis.T @ force)
    kept: list[StiffnessUpdate] = []
    inside = StiffenedPreconditioner.apply
    monkeypatch.setattr(
        StiffenedPreconditioner, "apply",
        lambda self, *given: (kept.append(self.stiffening), inside(self, *given))[1],
    )  # fmt: skip
    descent = descent_on(problem, space, EVERY)
    descent.descend(bent, np.full(1, 1e-12), 2)
    preconditioner, out = StiffenedPreconditioner(factor, problem), problem.device.allocate(problem.rows, 1)
    preconditioner.stiffening = kept[0]
    preconditioner.apply(problem.device.upload(force), np.ones(1, bool), out)
    off = np.linalg.norm(out.numpy()[:, 0] - exact) / np.linalg.norm(exact)
    assert off < 1e-3 < 0.03 < np.linalg.norm(at_rest - exact) / np.linalg.norm(exact)


def test_next_frame_reuses_the_stiffness_update() -> None:
    problem, space, rest = hard()
    descent = descent_on(problem, space)
    there = descent.descend(rest, np.full(1, 1e-6), 400, {})
    assert there.steps[0] > RENEWAL.max_reused_steps and there.warm_start == {}
    first = descent.descend(there.u, np.full(1, 1e-8), 400, {})
    assert (
        first.status[0] == DONE
        and first.steps[0] <= RENEWAL.max_reused_steps
        and set(first.warm_start) == set(UPDATE_KEYS.values())
    )
    again = descent.descend(there.u, np.full(1, 1e-8), 400, first.warm_start)
    np.testing.assert_array_equal(again.u.numpy(), first.u.numpy())
    for name, array in first.warm_start.items():
        assert np.shares_memory(again.warm_start[name], array)
    assert descent.descend(there.u, np.full(1, 1e-8), 400).warm_start == {}


@pytest.mark.parametrize("name", UPDATE_KEYS.values())
@pytest.mark.parametrize("fault", ["missing", "short", "negative", "large", "kind"])
def test_inconsistent_stiffness_update_is_ignored(name: str, fault: str) -> None:
    problem, space, rest = hard()
    descent = descent_on(problem, space)
    there = descent.descend(rest, np.full(1, 1e-6), 400, {}).u
    first = descent.descend(there, np.full(1, 1e-8), 400, {})
    learnt, array = dict(first.warm_start), first.warm_start[name]
    whole = array.dtype.kind == "i"
    learnt[name] = {
        "missing": None,
        "short": array[..., 1:],
        "negative": np.where(np.arange(array.shape[-1]) == 1, -1 if whole else np.nan, array).astype(array.dtype),
        "large": np.where(np.arange(array.shape[-1]) == 1, 10**6 if whole else np.inf, array).astype(array.dtype),
        "kind": array.astype(str),
    }[fault]
    if fault == "missing":
        del learnt[name]
    np.testing.assert_array_equal(descent.descend(there, np.full(1, 1e-8), 400, learnt).u.numpy(), first.u.numpy())


def test_singular_stiffness_update_is_ignored() -> None:
    problem, space, rest = hard()
    descent = descent_on(problem, space)
    there = descent.descend(rest, np.full(1, 1e-6), 400, {}).u
    first = descent.descend(there, np.full(1, 1e-8), 400, {})
    learnt = {name: np.zeros_like(array) for name, array in first.warm_start.items()}
    np.testing.assert_array_equal(descent.descend(there, np.full(1, 1e-8), 400, learnt).u.numpy(), first.u.numpy())


def test_indefinite_update_falls_back_to_rest_stiffness() -> None:
    """A model with strongly negative stiffness would send every step uphill."""
    problem, space, _ = hard("p1")
    factor, rows = factor_of(problem), np.arange(3 * len(space.nodes))
    preconditioner = StiffenedPreconditioner(factor, problem)
    g = problem.device.upload(
        problem.constraint.build_basis() @ np.ones((problem.constraint.build_basis().shape[1], 1))
    )
    plain, out = problem.device.allocate(problem.rows, 1), problem.device.allocate(problem.rows, 1)
    factor.apply(g, np.ones(1, bool), plain)
    size = len(rows)
    added = 1e6 * np.eye(size, dtype=np.float32)
    preconditioner.stiffening = StiffnessUpdate(
        rows, added, np.eye(size, dtype=np.float32), np.arange(size, dtype=np.int32)
    )
    preconditioner.apply(g, np.ones(1, bool), out)
    np.testing.assert_array_equal(out.numpy(), plain.numpy())


def test_strained_descent_out_of_budget_is_finite() -> None:
    problem, space, rest = hard()
    descent = descent_on(problem, space)
    found = descent.descend(rest, np.full(1, 1e-12), 3)
    assert found.status[0] == GOING and found.steps[0] <= 3 and found.unfinished_cases.tolist() == [0]
    _, free, scale = problem.residual(found.u)
    np.testing.assert_allclose(found.residual, free / scale, rtol=1e-6)
    broken = descent.descend(problem.device.upload(np.full((problem.rows, 1), np.nan)), np.full(1, 1e-12), 20)
    assert broken.status[0] == NOT_FINITE


def live(*avoid: SolverStep) -> Fem:
    effects = (Elasticity(tissue(LAW)), *EFFECTS)
    return Fem(body()[0], effects, replace(LIVE, tolerance=1e-4), "cpu", element="smoothed", live=True, avoid=avoid)


def frames(fem: Fem) -> list[Deformation]:
    """A pull that grows, each frame from the one before."""
    found: list[Deformation] = []
    for share in np.linspace(0.78, 0.8, 5):
        found.append(fem.deform(loads_of(share * HARD), found[-1] if found else None))
    return found


def test_live_frames_take_fewer_steps_to_same_result() -> None:
    found, expected = frames(live()), frames(live(SolverStep.STRAINED))
    assert {answer.outcome[0] for answer in found} == {Outcome.CONVERGED}
    size = np.abs(expected[-1].displacement).max()
    for mine, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine.displacement, other.displacement, atol=1e-3 * size)
    assert sum(int(answer.iterations[0]) for answer in found) <= 0.6 * sum(int(each.iterations[0]) for each in expected)
    served = [set(UPDATE_KEYS.values()) <= set(answer.warm) for answer in found]
    assert any(served)
    np.testing.assert_array_equal(frames(live())[-1].displacement, found[-1].displacement)


def test_update_has_nodes_nearest_to_the_opening() -> None:
    problem, space, rest = hard()
    strains, kept = replace(SINGLE_LIMITS, max_candidates=200, max_nodes=30), Renewal(max_reused_steps=400)
    descent = descent_on(problem, space, strains, kept)
    rows = descent.descend(rest, np.full(1, 1e-6), 400, {}).warm_start[UPDATE_KEYS["rows"]][0]
    assert len(np.unique(rows)) == len(rows) == 90
    distance = np.linalg.norm(space.nodes[:, None] - space.nodes[OPENING], axis=2).min(axis=1)
    assert distance[rows // 3].max() <= np.sort(distance)[199]

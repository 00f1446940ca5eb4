"""Solvers of a part of the body by itself: what holds for each of them, whatever part it takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from openings import EFFECTS, FINE, LAWS_AND_ELEMENTS, TOTAL, begun, body, descent_of, equilibria, loads_of
from oracle import tissue

from sim.compile import compile_problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity
from sim.local_solvers.batch_elimination import BatchElimination, batch_elimination
from sim.local_solvers.outer_loop import Limits
from sim.local_solvers.patch import Patch
from sim.local_solvers.patch_elimination import patch_elimination
from sim.minimisers.lbfgs_kernels import BROKEN, DONE, LIVE
from sim.runtime.device import find_device

LAW = "stable-neo-hookean"


@dataclass(frozen=True)
class Kind:
    """What makes a solver, how many columns it takes, rows of TOTAL that it tries, and the step whose forces grow."""

    make: Callable[..., Any]
    columns: int
    tried: tuple[int, ...]
    holder: type
    step: str
    larger: Callable[[Any, float], Any]


def larger_array(force: wp.array, factor: float) -> wp.array:
    return wp.array(factor * force.numpy().astype(np.float64), dtype=force.dtype, device=force.device)


NEAR = Kind(batch_elimination, len(TOTAL), (0, 1, 2, 3), BatchElimination, "_corrected", larger_array)
PATCH = Kind(patch_elimination, 1, (3,), Patch, "settled", lambda found, factor: (found[0], factor * found[1]))
EACH = pytest.mark.parametrize("kind", [pytest.param(NEAR, id="near"), pytest.param(PATCH, id="patch")])


@EACH
@LAWS_AND_ELEMENTS
def test_it_ends_where_the_whole_does(kind: Kind, law: str, element: str) -> None:
    problem, space = begun(law, element)
    descent, expected = descent_of(kind.make, problem, space, law), equilibria(problem)
    last = []
    for first in range(0, len(TOTAL), kind.columns):
        rows = np.arange(first, first + kind.columns)
        problem.begin(Cases(loads_of(TOTAL[rows]), np.zeros(len(rows))))
        found = descent.descend(problem.device.zeros(problem.rows, len(rows)), np.full(len(rows), FINE), 100)
        assert (found.status == DONE).all() and (found.residual <= FINE).all()
        np.testing.assert_allclose(found.u.numpy(), expected[:, rows], atol=1e-5 * np.abs(expected).max())
        last = [found.steps[-1], np.abs(found.u.numpy()[:, -1]).max()]
    assert last == [0, 0.0]


@EACH
def test_the_budget_leaves_a_finite_state_and_says_so(kind: Kind) -> None:
    problem, space = begun(LAW, total=TOTAL[3:4])
    descent, rest = descent_of(kind.make, problem, space, LAW), problem.device.zeros(problem.rows, 1)
    found = descent.descend(rest, np.full(1, 1e-12), 2)
    assert found.status[0] == LIVE and found.steps[0] <= 2 and found.left.tolist() == [0]
    _, free, scale = problem.residual(found.u)
    np.testing.assert_allclose(found.residual, free / scale, rtol=1e-6)
    assert found.residual[0] < 0.5
    broken = descent.descend(problem.device.array(np.full((problem.rows, 1), np.nan)), np.full(1, 1e-12), 2)
    assert broken.status[0] == BROKEN


@EACH
@pytest.mark.parametrize("factor", [1e3, 1e12, 1e30])
def test_a_cycle_that_explodes_is_not_taken(kind: Kind, monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Forces so large that they overflow, or that what is free of them looks small beside the rest."""
    anatomy, space = body()
    problem = compile_problem((Elasticity(tissue(LAW)), *EFFECTS), anatomy, find_device("cpu", "float32"), space)
    problem.begin(Cases(loads_of(TOTAL[list(kind.tried)]), np.zeros(len(kind.tried))))
    descent, inside = descent_of(kind.make, problem, space, LAW), getattr(kind.holder, kind.step)
    monkeypatch.setattr(kind.holder, kind.step, lambda *args: kind.larger(inside(*args), factor))
    count = len(kind.tried)
    found = descent.descend(problem.device.zeros(problem.rows, count), np.full(count, 1e-4), 100)
    assert (found.status == LIVE).all() and not found.u.numpy().any()
    np.testing.assert_allclose(found.residual, 1.0)


@EACH
def test_what_gets_no_nearer_is_left_to_others(kind: Kind) -> None:
    problem, space = begun(LAW, total=TOTAL[:1])
    found = descent_of(kind.make, problem, space, LAW).descend(problem.device.zeros(problem.rows, 1), np.zeros(1), 100)
    assert found.status[0] == LIVE and found.residual[0] < 1e-12
    assert found.steps[0] <= Limits().cycles and found.steps[0] < 20 + Limits().patience

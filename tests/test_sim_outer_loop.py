"""Cycles between part and whole: columns passed on, and rejected cycles."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from openings import EFFECTS, FINE, TOTAL, begun, body, descent_of, loads_of
from oracle import tissue
from test_sim_batch_elimination import LAW

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity
from sim.fem import Fem
from sim.linalg.preconditioner import build_rest_solver
from sim.local_solvers.batch_elimination import BatchElimination, build_batch_elimination
from sim.local_solvers.outer_loop import CycleLimits
from sim.minimisers.lbfgs_kernels import LIVE
from sim.runtime.device import find_device
from sim.strategy.plan import SolverStep

STEP = "_run_cycle"


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
        some = replace(near, limits=CycleLimits(max_cycles=cycles))
        fem.strategy = replace(fem.strategy, build_batch_solver=lambda some=some: some)
        found = fem.deform(loads_of(many))
        assert all(outcome.good for outcome in found.outcome)
        assert (found.iterations != plain.iterations).any()
        assert all(len(value) == len(many) for value in found.memory.values())
        largest = np.abs(plain.displacement).max()
        np.testing.assert_allclose(found.displacement, plain.displacement, atol=1e-5 * largest)


def larger(force: wp.array, factor: float) -> wp.array:
    return wp.array(factor * force.numpy().astype(np.float64), dtype=force.dtype, device=force.device)


@pytest.mark.parametrize("factor", [1e3, 1e12, 1e30])
def test_diverging_cycle_is_rejected(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Forces that overflow, or residuals that look small compared with them."""
    anatomy, space = body()
    problem = compile_problem((Elasticity(tissue(LAW)), *EFFECTS), anatomy, find_device("cpu", "float32"), space)
    problem.begin(Cases(loads_of(TOTAL[:4]), np.zeros(4)))
    descent, inside = descent_of(build_batch_elimination, problem, space, LAW), getattr(BatchElimination, STEP)
    monkeypatch.setattr(BatchElimination, STEP, lambda *args: larger(inside(*args), factor))
    found = descent.descend(problem.device.allocate(problem.rows, 4), np.full(4, 1e-4), 100)
    assert (found.status == LIVE).all() and not found.u.numpy().any()
    np.testing.assert_allclose(found.residual, 1.0)


def test_stagnating_cycle_is_passed_on_to_next_solver() -> None:
    problem, space = begun(LAW, total=TOTAL[:1])
    found = descent_of(build_batch_elimination, problem, space, LAW).descend(
        problem.device.allocate(problem.rows, 1), np.zeros(1), 100
    )
    assert found.status[0] == LIVE and found.residual[0] < 1e-12
    assert found.steps[0] <= CycleLimits().max_cycles and found.steps[0] < 20 + CycleLimits().patience

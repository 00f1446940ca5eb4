"""The rest stiffness, solved with and without a factorisation."""

from dataclasses import replace

import numpy as np
import pytest
from test_sim_multigrid import built

from sim.errors import InputError
from sim.linalg.rest_solver import RestStiffnessSolver


def test_linear_solution_without_factorisation_agrees():
    """Terms of a series: by a factorisation, and by conjugate gradients where it would not pay."""
    problem, preconditioner = built("smoothed", 0.45, (2, 2, 3))
    free = problem.constraint.build_basis()
    force = free @ np.random.default_rng(0).normal(size=(len(free.indptr) - 1, 3))
    direct, iterated = (RestStiffnessSolver(problem, preconditioner, 400, max_factorised=most) for most in (10**6, 0))
    assert direct.exact_inverse is not None and iterated.exact_inverse is None
    one, other = (resting.solve(problem.device.upload(force)).numpy() for resting in (direct, iterated))
    np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(one).max())
    with pytest.raises(InputError, match="did not reach 1e-09 in 1 iterations"):
        replace(iterated, max_iterations=1).solve(problem.device.upload(force))

"""Contact forces on the nodes near a tool: against their own equation."""

from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import pytest
from test_sim_contact_descent import HEIGHT, Rough, at, parts, touching

from sim.discretisation.term import Cases
from sim.linalg.compliance import Compliance
from sim.linalg.pcg import Preconditioner
from sim.local_solvers.contact_forces import ContactCompliance, ForceLimits, allocate_scratch, solve_contact_forces


@pytest.mark.parametrize(("drag", "rough"), [(0.0, 0.0), (0.5, 0.0), (0.0, 1e-3)])
def test_contact_forces_satisfy_their_equation(drag: float, rough: float) -> None:
    """f = c'(w) + d (w - v) where that is not zero, w = w1 - C (f - f1): for each column separately, in a few steps.

    A preconditioner in half precision rounds each of C's columns by itself.
    """
    fem, descent = parts()
    whole, n = fem.strategy.preconditioner, len(descent.barrier.touchable_nodes)

    soft = Compliance(fem.problem, cast(Preconditioner, Rough(whole, rough)), descent.barrier.touchable_nodes)
    device = replace(fem.problem.device, precision="float64")
    shallow = (at(0.031, 0.028, HEIGHT - 3e-4), at(0.02, 0.02, HEIGHT - 2e-4), at(0.0, 0.0, 0.2))
    fem.problem.begin(Cases(touching(*shallow), np.zeros(3)))
    barrier = descent.barrier.reduce(np.arange(3))
    assert barrier is not None
    here, known = np.zeros((3 * n, 3)), np.zeros((3 * n, 3))
    model, few = ContactCompliance(soft, device, partial(allocate_scratch, device)), ForceLimits(max_iterations=20)
    force, found = solve_contact_forces(
        barrier, model, here, here + 1e-4, known, np.full(3, 1e-6), np.full(3, drag), few
    )
    assert found.all() and not force[:, 2].any()
    between = soft.build_matrix(np.ones(n, bool))
    w = here + 1e-4 - 0.5 * (between + between.T) @ force
    slope, touched = barrier.compute_gradient(w), (barrier.compute_gradient(here) != 0.0).reshape(n, 3, 3).any(axis=1)
    for column in range(2):
        rows = np.repeat(touched[:, column], 3)
        stiff = drag / np.diag(between)[rows].mean()
        slope[rows, column] += stiff * w[rows, column]
        np.testing.assert_allclose(force[:, column], slope[:, column], atol=1e-5 * np.abs(slope[:, column]).max())

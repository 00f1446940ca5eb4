"""The barrier on the nodes that tools can touch, against the whole term."""

import numpy as np
import pytest
from test_sim_contact_descent import DOWN, parts, touching

from sim.discretisation.term import Cases


@pytest.mark.parametrize("definite", [False, True])
def test_reduced_barrier_agrees_with_whole_term(definite: bool) -> None:
    """Its gradient, and its curvature against the term's own product."""
    fem, descent = parts()
    problem, term, nodes = fem.problem, descent.barrier, descent.barrier.touchable_nodes
    problem.begin(Cases(touching(DOWN), np.zeros(1)))
    rng = np.random.default_rng(2)
    u = 1e-4 * rng.normal(size=(problem.rows, 1))
    rows, place = descent.compliance.rows[: 3 * len(nodes)], problem.device.upload(u)
    expected = problem.device.allocate(problem.rows, 1)
    term.add_gradient(place, expected)
    barrier = term.reduce(np.zeros(1, int))
    assert barrier is not None and np.abs(expected.numpy()).max() > 1e-3
    np.testing.assert_allclose(barrier.compute_gradient(u[rows]), expected.numpy()[rows], rtol=1e-9, atol=1e-12)
    p, product = rng.normal(size=(problem.rows, 1)), problem.device.allocate(problem.rows, 1)
    problem.linearise(place, np.array([definite]))
    term.add_curvature(problem.device.upload(p), product)
    every = np.arange(len(nodes))[:, None]
    matrix = barrier.compute_stiffness(u[rows], every, len(nodes), np.array([definite]))[0]
    np.testing.assert_allclose(matrix @ p[rows], product.numpy()[rows], rtol=1e-8, atol=1e-9 * np.abs(matrix).max())

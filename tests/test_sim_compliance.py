"""Columns of the compliance against the preconditioner, in any order."""

from typing import cast

import numpy as np
from test_sim_contact_descent import Rough, parts

from sim.linalg.compliance import ColumnCache, Compliance
from sim.linalg.pcg import Preconditioner


def test_compliance_columns_agree_with_preconditioner() -> None:
    fem, descent = parts()
    soft, rng = descent.compliance, np.random.default_rng(1)
    nodes = soft.nodes
    assert np.array_equal(nodes[: len(descent.barrier.touchable_nodes)], descent.barrier.touchable_nodes)
    force = np.zeros((len(nodes), 3, 2))
    some = rng.permutation(len(nodes))[:5]
    force[some] = rng.normal(size=(5, 3, 2))
    force = force.reshape(-1, 2)
    whole = np.zeros((fem.problem.rows, 2))
    whole[soft.rows] = force
    expected = soft.apply(whole)
    size = np.abs(expected).max()
    np.testing.assert_allclose(soft.compute_full_motion(force), expected, atol=1e-6 * size)
    between = soft.build_matrix(np.isin(np.arange(len(nodes)), some))
    np.testing.assert_allclose(between @ force, expected[soft.rows], atol=1e-6 * size)
    np.testing.assert_allclose(soft.compute_motion(force), expected[soft.rows], atol=1e-6 * size)


def test_compliance_columns_are_bit_identical_in_any_order() -> None:
    fem, descent = parts()
    nodes = descent.barrier.touchable_nodes
    preconditioner = cast(Preconditioner, Rough(fem.strategy.preconditioner, 0.0))
    assert len(nodes) > 3 * ColumnCache().block_size
    one, other = (Compliance(fem.problem, preconditioner, nodes) for _ in range(2))
    every = np.ones(len(nodes), bool)
    other.build_matrix(np.arange(len(nodes)) == len(nodes) - 1)
    np.testing.assert_array_equal(one.build_matrix(every), other.build_matrix(every))

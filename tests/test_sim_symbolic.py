"""The order of elimination: nested dissection, fronts and fill."""

from itertools import chain

import numpy as np
import pytest
import scipy.sparse as sp
from test_sim_multifrontal import sliding, system

from sim.linalg.multifrontal import find_moved_nodes
from sim.linalg.symbolic import build_fronts, order_by_dissection


def test_dissection_gives_disjoint_parts_of_similar_size() -> None:
    stiffness, motions = system(sliding())
    free = sp.csc_array(motions.T @ stiffness @ motions)
    _, (first, second, last) = build_fronts(free, find_moved_nodes(motions), 2)
    for front in first:
        assert not ((front.border >= first[-1].stop) & (front.border < second[-1].stop)).any()
    loads = [sum((front.stop - front.first) * len(front.rows) for front in part) for part in (first, second, last)]
    assert min(loads[:2]) > 0.5 * max(loads[:2])
    assert sum(loads) > 1.1 * (max(loads[:2]) + loads[2])


def test_front_touches_only_later_unknowns() -> None:
    """Every entry of the matrix lies within the front of its earlier unknown."""
    stiffness, motions = system(sliding())
    free = sp.csc_array(motions.T @ stiffness @ motions)
    order, parts = build_fronts(free, find_moved_nodes(motions), 2)
    fronts = [front for part in parts for front in part]
    assert sorted(order) == list(range(free.shape[0]))
    assert len(fronts) > 4
    assert [front.first for front in fronts[1:]] == [front.stop for front in fronts[:-1]]
    assert fronts[-1].stop == free.shape[0]
    matrix = sp.csc_array(free[order][:, order])
    for front in fronts:
        assert (np.diff(front.border) > 0).all()
        assert (front.border >= front.stop).all()
        touched = matrix[:, np.arange(front.first, front.stop)].nonzero()[0]
        assert set(touched[touched >= front.first]) <= set(front.rows)


@pytest.mark.parametrize("later", [False, True])
def test_fronts_of_triangular_and_full_matrix_agree(later: bool) -> None:
    stiffness, motions = system(sliding())
    whole, node = sp.coo_array(motions.T @ stiffness @ motions), find_moved_nodes(motions)
    first, second = node[whole.row], node[whole.col]
    kept = (np.random.default_rng(4).random((node.max() + 1,) * 2)[first, second] > 0.02) | (first == second)
    kept |= (first < second) == later
    left = sp.coo_array((whole.data[kept], (whole.row[kept], whole.col[kept])), whole.shape)
    (order, parts), (same, others) = (build_fronts(sp.csc_array(one), node, 2) for one in (whole, left))
    np.testing.assert_array_equal(order, same)
    for front, other in zip(chain(*parts), chain(*others), strict=True):
        np.testing.assert_array_equal(front.rows, other.rows)


def test_dissection_leaves_little_fill() -> None:
    """A chain of a thousand nodes: an order that ignores the graph fills it."""
    line = sp.csr_array(sp.diags_array([np.ones(999), np.ones(999)], offsets=[-1, 1]).astype(np.int8))
    assert sorted(order_by_dissection(line)) == list(range(1000))
    matrix = sp.csc_array(sp.diags_array([-np.ones(999), np.full(1000, 3.0), -np.ones(999)], offsets=[-1, 0, 1]))
    _, parts = build_fronts(matrix, np.arange(1000))
    assert max(len(front.border) for part in parts for front in part) <= 4

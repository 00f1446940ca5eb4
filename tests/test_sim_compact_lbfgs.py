"""Curvature pairs of one column and of many against BFGS."""

import numpy as np
import pytest

from sim.minimisers.compact_lbfgs import BatchHistory, CurvaturePairs, build_empty_history
from sim.minimisers.lbfgs_kernels import PAIRS
from sim.runtime.device import Device


def bfgs(inverse: np.ndarray, steps: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Nocedal, Wright 2006, equation 6.17, pair after pair."""
    for s, y in zip(steps, changes, strict=True):
        left = np.eye(len(s)) - np.outer(s, y) / (s @ y)
        inverse = left @ inverse @ left.T + np.outer(s, s) / (s @ y)
    return inverse


def learnt_pairs(count: int) -> tuple[CurvaturePairs, np.ndarray, np.ndarray]:
    """Pairs of random steps (the last PAIRS count), the inverse they began with and the one that BFGS has."""
    rng, size = np.random.default_rng(5), 30
    stiffness, change = (matrix @ matrix.T for matrix in rng.normal(size=(2, size, size)))
    begun = np.linalg.inv(stiffness + size * np.eye(size))
    steps = rng.normal(size=(count, size))
    changes = steps @ (stiffness + change)
    pairs = build_empty_history(size, "float64")
    for s, y in zip(steps, changes, strict=True):
        pairs = pairs.add_pair(s, y, begun @ y)
    return pairs, begun, bfgs(begun, steps[-PAIRS:], changes[-PAIRS:])


@pytest.mark.parametrize("count", [0, 1, 3, PAIRS, PAIRS + 3])
def test_curvature_pairs_agree_with_bfgs(count: int) -> None:
    pairs, begun, expected = learnt_pairs(count)
    force = np.random.default_rng(6).normal(size=len(begun))
    np.testing.assert_allclose(
        begun @ force + pairs.compute_motion(pairs.compute_weights(force)), expected @ force, rtol=1e-8
    )


def test_columns_of_curvature_pairs_are_independent() -> None:
    """Against BFGS: one column is always active, one starts late, one has too many pairs, one has dropped its pairs."""
    rng, size = np.random.default_rng(5), 30
    stiffness, change = (matrix @ matrix.T for matrix in rng.normal(size=(2, size, size)))
    begun = np.linalg.inv(stiffness + size * np.eye(size))
    pairs, known = BatchHistory(Device("cpu", "float64"), size, 4), [[] for _ in range(4)]
    for turn in range(PAIRS + 3):
        columns = np.array([0, 1, 2, 3] if turn < 2 else [0, 2] if turn < PAIRS else [2])
        s = rng.normal(size=(size, len(columns)))
        y = (stiffness + change) @ s
        pairs.update_history(columns, s, y, begun @ y)
        for place, column in enumerate(columns):
            known[column].append((s[:, place], y[:, place]))
    pairs.clear(np.array([3]))
    pairs.keep(np.array([2, 1, 3]))
    force = rng.normal(size=(size, 3))
    learnt = pairs.get_history(np.arange(3))
    found = begun @ force + learnt.compute_motion(learnt.compute_weights(force))
    for place, column in enumerate((2, 1, 3)):
        last = [] if column == 3 else known[column][-PAIRS:]
        steps, changes = (np.array([pair[i] for pair in last]).reshape(-1, size) for i in range(2))
        np.testing.assert_allclose(found[:, place], bfgs(begun, steps, changes) @ force[:, place], rtol=1e-7)

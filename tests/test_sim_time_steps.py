"""Time steps of a batch."""

import numpy as np

from sim.strategy.time_steps import group_time_steps


def test_similar_time_steps_share_a_batch() -> None:
    steps = np.array([0.01, 1e3, 0.0101, 1e-4, 0.009, 0.0])
    found = [(step, rows.tolist()) for step, rows in group_time_steps(steps, 2)]
    assert found == [(0.0, [5]), (2.0**-13, [3]), (2.0**-7, [0, 2]), (2.0**-7, [4]), (np.inf, [1])]

"""Load steps of cases on the path to the whole load."""

import numpy as np

from sim.strategy.stepping import LoadProgress


def test_step_size_grows_on_success_and_shrinks_on_failure():
    shares, rows, good = LoadProgress.start(0.25, np.ones(2)), np.arange(2), np.array([True, False])
    aim, _ = shares.propose_fractions(rows)
    shares.take_steps(rows, aim, good)
    shares.resize_steps(rows, good, np.array([9.0, 9.0]), shrink=0.5, widen=3.0)
    assert shares.reached_fraction.tolist() == [0.25, 0.0] and shares.next_step.tolist() == [0.5, 0.125]
    assert shares.path_in_gaps.tolist() == [1.0, 3.0]

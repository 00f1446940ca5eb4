"""Statistics of episodes."""

import numpy as np

from scenes.episodes.exports.statistics import Spread


def test_statistics_of_parts_are_those_of_the_whole():
    rows = np.random.default_rng(0).normal(size=(20, 3))
    rows[3, 1] = np.nan
    said = (Spread.of(rows[:7]) + Spread.of(rows[7:])).said()
    for name, of in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        assert np.allclose(said[name], of(rows, axis=0))
    assert said["count"] == [20] and Spread.of(np.full((2, 1), np.nan)).said()["mean"] == [0.0]

"""Settings of regressors: selection and benefit."""

from functools import partial

import numpy as np

from surrogate.regressors.baselines import Svr
from surrogate.training.learners import SVR_CANDIDATES, TunedRegressor, find_inner_discs


def nearby(count, seed):
    """Rows of `compute_tool_features`, and outputs that bend: the published tube is as wide as what it leaves."""
    X = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 8)) * 1e-2
    bend = 1e2 * X @ np.random.default_rng(1).normal(size=(8, 3))
    return X, np.sin(0.7 * bend) * [1.0, 0.3, 0.1]


def test_tuned_settings_reduce_the_published_svr_error():
    (X, Y), (asked, truth) = nearby(600, 0), nearby(200, 2)
    miss = [
        np.abs(model.predict(asked) - truth).mean()
        for model in (Svr().fit(X, Y), TunedRegressor(SVR_CANDIDATES).fit(X, Y))
    ]
    assert miss[1] < 0.6 * miss[0]
    again = TunedRegressor(SVR_CANDIDATES).fit(X, Y)
    assert np.array_equal(again.predict(asked), TunedRegressor(SVR_CANDIDATES).fit(X, Y).predict(asked)) and isinstance(
        again, Svr
    )


def test_settings_are_chosen_on_inner_held_out_discs():
    """One fit without the discs for each setting, and one of the best setting to all rows."""
    X, Y = nearby(100, 0)
    seen, left_out = [], find_inner_discs(X[:, :3])
    assert 0.15 < left_out.mean() < 0.25

    class Off:
        def __init__(self, by):
            self.by = by

        def fit(self, X, Y):
            seen.append((self.by, X))
            return self

        def predict(self, asked):
            assert np.array_equal(asked, X[left_out])
            order = np.sort(np.argsort(-Y.std(axis=0), kind="stable")[:8])
            return Y[left_out][:, order] + self.by

    chosen = TunedRegressor(tuple(partial(Off, by) for by in (2.0, 0.5, 1.0))).fit(X, Y)
    assert chosen.by == 0.5 and [by for by, _ in seen] == [2.0, 0.5, 1.0, 0.5]
    assert all(np.array_equal(rows, X[~left_out]) for _, rows in seen[:3]) and len(seen[3][1]) == 100
    assert TunedRegressor((partial(Off, 2.0), partial(Off, 0.5))).fit(X[:30], Y[:30]).by == 2.0

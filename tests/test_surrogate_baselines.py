"""Regressors of published models."""

import numpy as np
from test_surrogate_protocol import RANDOM, rows

from surrogate.regressors.baselines import Pcr, Svr


def test_pcr_drops_components_of_small_variance():
    """A component with 0.1 % of the variance is dropped, and outputs that depend only on it are lost."""
    scores = np.random.default_rng(5).normal(size=(200, 3)) * [10.0, 3.0, 0.1]
    turned = np.linalg.qr(RANDOM.normal(size=(6, 3)))[0]
    X, Y = scores @ turned.T + 7.0, scores / [10.0, 3.0, 0.1] + 2.0
    few, all_ = Pcr(variance_share=0.999).fit(X, Y), Pcr(variance_share=1.0).fit(X, Y)
    assert np.allclose(all_.predict(X), Y, atol=1e-5)
    assert np.allclose(few.predict(X)[:, :2], Y[:, :2], atol=0.3) and few.predict(X)[:, 2].std() < 0.3
    assert np.linalg.matrix_rank(few.map_, tol=1e-9) == 2


def test_svr_matches_scikit_learn_with_published_settings():
    """Reference: scikit-learn's SVR with MATLAB's defaults, in the units of the output."""
    from sklearn.svm import SVR

    X, Y = rows(300, 0)
    y, iqr = Y[:, 0], np.subtract(*np.percentile(Y[:, 0], [75, 25]))
    mean, deviation = X.mean(axis=0), np.where(X.std(axis=0) > 1e-9, X.std(axis=0), 1.0)
    machine = SVR(C=iqr / 1.349, epsilon=iqr / 13.49, gamma=1.0 / 5.0, tol=1e-4 * iqr).fit((X - mean) / deviation, y)
    test, _ = rows(50, 1)
    assert np.allclose(Svr().fit(X, Y).predict(test)[:, 0], machine.predict((test - mean) / deviation), atol=0.01 * iqr)

"""Gaussian processes: likelihood, features and limits."""

import numpy as np
from test_surrogate_protocol import RANDOM, rows

from surrogate.regressors.gp import Gp, compute_matern, compute_negative_likelihood


def test_likelihood_equals_scikit_learn_likelihood():
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    x, y = RANDOM.normal(size=(40, 3)), RANDOM.normal(size=(40, 1))
    for log in (np.log([1.0, 2.0, 0.5, 0.1]), np.log([3.0, 0.7, 1.5, 0.01])):
        u = x / np.exp(log[:3])
        covariance = compute_matern(np.linalg.norm(u[:, None] - u, axis=2)) + np.exp(log[3]) * np.eye(40)
        variance = (y.T @ np.linalg.solve(covariance, y)).item() / 40
        kernel = ConstantKernel(variance) * (Matern(np.exp(log[:3]), nu=2.5) + WhiteKernel(np.exp(log[3])))
        theirs = GaussianProcessRegressor(kernel, optimizer=None).fit(x, y).log_marginal_likelihood_value_
        assert np.isclose(compute_negative_likelihood(log, x, y)[0], -theirs - 20.0 * (1.0 + np.log(2.0 * np.pi)))


def test_likelihood_gradient_matches_finite_differences():
    x, y, log = RANDOM.normal(size=(30, 3)), RANDOM.normal(size=(30, 4)), np.log([1.0, 2.0, 0.5, 0.1])
    steps = 1e-5 * np.eye(4)
    slope = [
        (compute_negative_likelihood(log + h, x, y)[0] - compute_negative_likelihood(log - h, x, y)[0]) / 2e-5
        for h in steps
    ]
    assert np.allclose(compute_negative_likelihood(log, x, y)[1], slope, rtol=1e-6)


def test_irrelevant_feature_gets_a_long_length_scale():
    X, Y = rows(300, 0)
    X[:, 4] = np.random.default_rng(6).normal(size=300)  # no output hangs on it
    model = Gp().fit(X, Y)
    assert model.length_[4] > 5.0 * model.length_[:4].max()


def test_gp_trains_on_subset_above_row_limit():
    X, Y = rows(300, 0)
    few = Gp(likelihood_rows=40, max_rows=120).fit(X, Y)
    assert len({*map(tuple, few.seen_)}) == 120
    assert np.abs(few.predict(X) - Y)[:, 0].max() < 0.2 * Y[:, 0].std()


def test_constant_outputs_are_predicted_exactly():
    X, _ = rows(30, 0)
    assert np.allclose(Gp().fit(X, np.full((30, 2), 3.0)).predict(X + 1.0), 3.0)

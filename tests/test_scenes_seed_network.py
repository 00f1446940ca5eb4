"""Network of the seed's protocol: its derivatives, its evidence, and noise that it does not learn."""

import numpy as np
import pytest

from scenes.report.seed_network import (
    BayesianNetwork,
    count_effective_weights,
    estimate_precisions,
    evaluate,
    initialise_weights,
    linearise,
    solve_regularised,
    take_damped_step,
)

RANDOM = np.random.default_rng(11)


@pytest.fixture(scope="module")
def networks():
    """Two noisy functions of three features, and networks during training: weights, x, y (r, n)."""
    x = RANDOM.uniform(-1.0, 1.0, (200, 3))
    y = np.stack([np.sin(2.0 * x[:, 0]) + x[:, 1], x[:, 2] ** 2]) + 0.1 * RANDOM.normal(size=(2, 200))
    weights, damping = initialise_weights(2, 3, 4, RANDOM), np.full(2, 1e-2)
    for _ in range(30):
        terms = linearise(weights, x, y)
        weights, _, damping = take_damped_step(weights, terms, x, y, np.ones(2), np.full(2, 50.0), damping)
    return weights, x, y


def compute_evidence(weights, x, y, alpha, beta):
    """Logarithm of MacKay's evidence by its definition: the Gaussian integral over the weights."""
    terms, count = linearise(weights, x, y), weights.shape[1]
    out = []
    for k in range(len(weights)):
        hessian = beta[k] * terms.hessian[k] + alpha[k] * np.eye(count)
        energy = 0.5 * (beta[k] * terms.error[k] + alpha[k] * weights[k] @ weights[k])
        norms = 0.5 * count * np.log(alpha[k]) + 0.5 * len(x) * np.log(beta[k] / (2.0 * np.pi))
        out.append(norms - energy - 0.5 * np.linalg.slogdet(hessian)[1])
    return np.array(out)


def test_a_network_has_the_published_weights():
    net = BayesianNetwork().fit(RANDOM.normal(size=(80, 13)), RANDOM.normal(size=(80, 2)))
    assert net.weights_.shape == (2, 61)


def test_derivatives_agree_with_finite_differences(networks):
    weights, x, y = networks
    steps = 1e-6 * np.eye(weights.shape[1])
    slopes = [(evaluate(weights + h, x)[1] - evaluate(weights - h, x)[1]) / 2e-6 for h in steps]
    J, error = np.stack(slopes, axis=2), evaluate(weights, x)[1] - y
    terms = linearise(weights, x, y)
    assert np.allclose(terms.hessian, J.transpose(0, 2, 1) @ J, rtol=1e-6, atol=1e-6)
    assert np.allclose(terms.gradient, np.einsum("rnp,rn->rp", J, error), rtol=1e-6, atol=1e-6)
    assert np.allclose(terms.error, (error**2).sum(axis=1))


def test_a_step_gains_what_it_returns(networks):
    _, x, y = networks
    weights = initialise_weights(2, 3, 4, np.random.default_rng(0))
    alpha, beta = np.full(2, 0.3), np.full(2, 20.0)

    def objective(w):
        return 0.5 * (beta * np.square(evaluate(w, x)[1] - y).sum(axis=1) + alpha * np.square(w).sum(axis=1))

    damping = np.array([1e-3, 1e-3])
    after, gained, damping = take_damped_step(weights, linearise(weights, x, y), x, y, alpha, beta, damping)
    assert (gained > 0.1).all() and np.allclose(objective(after), (1.0 - gained) * objective(weights))
    best = after
    for _ in range(200):
        best, gained, damping = take_damped_step(best, linearise(best, x, y), x, y, alpha, beta, damping)
    slope = beta[:, None] * linearise(best, x, y).gradient + alpha[:, None] * best
    assert np.abs(slope).max() < 1e-5 and (gained < 1e-9).all()


def test_precisions_maximise_the_evidence(networks):
    weights, x, y = networks
    terms = linearise(weights, x, y)
    alpha, beta = np.array([30.0, 1e-3]), np.array([1.0, 1e4])
    poor = compute_evidence(weights, x, y, alpha, beta)
    for _ in range(200):
        effective = count_effective_weights(terms.hessian, alpha, beta)
        alpha, beta = estimate_precisions(weights, terms.error, effective, len(x))
    best = compute_evidence(weights, x, y, alpha, beta)
    assert (best > poor + 10.0).all()
    for a, b in ((1.2, 1.0), (0.8, 1.0), (1.0, 1.1), (1.0, 0.9)):
        assert (compute_evidence(weights, x, y, a * alpha, b * beta) < best).all()


def test_the_network_separates_noise_from_signal():
    """It follows a noisy signal, and learns nothing from noise alone: 61 free weights would miss 0.04."""
    x = RANDOM.uniform(-1.0, 1.0, (900, 13))
    clean = np.column_stack([np.tanh(2.0 * x[:, 0] - x[:, 1]) + 0.5 * x[:, 2], 0.0 * x[:, 0]])
    net = BayesianNetwork().fit(x[:400], (clean + 0.1 * RANDOM.normal(size=clean.shape))[:400])
    miss = (net.predict(x[400:]) - clean[400:]).std(axis=0)
    assert miss[0] < 0.06 and miss[1] < 0.015


def test_vanishing_damping_keeps_the_matrix_regular():
    """Two equal columns, and a noise of zero: training on few loads must not stop with a traceback."""
    matrix = 1e20 * np.ones((1, 2, 2)) + 1e-6 * np.eye(2)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(matrix, np.ones((1, 2, 1)))
    assert np.allclose(solve_regularised(matrix, np.ones((1, 2))), 0.5e-20, rtol=1e-3)
    regular = np.array([[[2.0, 1.0], [1.0, 3.0]]])
    assert np.allclose(solve_regularised(regular, np.array([[3.0, 4.0]])), 1.0)

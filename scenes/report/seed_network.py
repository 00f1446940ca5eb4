"""Neural network of Tonutti, Gras, Yang 2017: four hidden units per output, with Bayesian regularisation."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

# Damping of MATLAB's `trainbr`: initial value, factors after an accepted and a rejected step, largest value.
INITIAL_DAMPING, DECREASE, INCREASE, MAX_DAMPING = 5e-3, 0.1, 10.0, 1e10
MIN_SQUARED_ERROR = 1e-20  # Smallest sum of squared errors of outputs in [-1, 1] that is not taken as zero.


@dataclass(eq=False)
class BayesianNetwork:
    """Network of tanh units for each output, with weight decay estimated from the evidence.

    Training minimises beta E_D + alpha E_W by Levenberg-Marquardt; E_D and E_W are half the sums of squared errors and
    of squared weights. Alpha and beta are estimated before every step: Foresee, Hagan 1997, "Gauss-Newton approximation
    to Bayesian learning", ICNN 3:1930-1935. As in MATLAB's `trainbr`, which Tonutti, Gras, Yang 2017 used, features and
    outputs are scaled to [-1, 1], weights are initialised by Nguyen and Widrow's rule, and there are at most 1,000
    steps. In contrast, training stops at a relative gain below `min_gain`, and all rows are training rows.

    Parameters
    ----------
    hidden
        Number of hidden units of each network; 4 units and 13 features give 61 weights.
    steps
        Maximum number of steps.
    min_gain
        Relative improvement of the objective below which training stops.
    seed
        Random seed of the initial weights.
    """

    hidden: int = 4
    steps: int = 1000
    min_gain: float = 1e-5
    seed: int = 0

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit the r networks to features X (n, f) and outputs Y (n, r); return this object."""
        self.middle_, self.half_ = compute_unit_range(X)
        self.offset_, self.scale_ = compute_unit_range(Y)
        x, y = (X - self.middle_) / self.half_, ((Y - self.offset_) / self.scale_).T
        weights = initialise_weights(len(y), x.shape[1], self.hidden, np.random.default_rng(self.seed))
        terms = linearise(weights, x, y)
        # Initially every weight counts as determined by the data.
        alpha, beta = estimate_precisions(weights, terms.error, np.full(len(y), float(weights.shape[1])), len(x))
        damping = np.full(len(y), INITIAL_DAMPING)
        active = np.arange(len(y))
        for _ in range(self.steps):
            weights[active], gain, damping[active] = take_damped_step(
                weights[active], terms, x, y[active], alpha[active], beta[active], damping[active]
            )
            active = active[gain >= self.min_gain]
            if not len(active):
                break
            terms = linearise(weights[active], x, y[active])
            effective = count_effective_weights(terms.hessian, alpha[active], beta[active])
            alpha[active], beta[active] = estimate_precisions(weights[active], terms.error, effective, len(x))
        self.weights_ = weights
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict outputs (B, r) from features (B, f)."""
        outputs = evaluate(self.weights_, (X - self.middle_) / self.half_)[1].T
        return outputs * self.scale_ + self.offset_


class GaussNewtonTerms(NamedTuple):
    """J^T J (r, P, P), J^T e (r, P) and e^T e (r,), for the errors e (n,) of each network with Jacobian J (n, P)."""

    hessian: np.ndarray
    gradient: np.ndarray
    error: np.ndarray


def compute_unit_range(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and half widths (f,) of the ranges of columns (n, f); a constant column has the half width 1."""
    low, high = values.min(axis=0), values.max(axis=0)
    half = 0.5 * (high - low)
    return 0.5 * (high + low), np.where(half > 1e-9 * np.maximum(np.abs(low), np.abs(high)), half, 1.0)


def initialise_weights(outputs: int, features: int, hidden: int, random: np.random.Generator) -> np.ndarray:
    """Draw initial weights (r, P) of `outputs` networks: hidden x (features and bias), then output weights and bias.

    Nguyen, Widrow 1990, "Improving the learning speed of 2-layer neural networks", IJCNN 3:21-26.
    """
    inner = random.normal(size=(outputs, hidden, features))
    size = 0.7 * hidden ** (1.0 / features)
    inner *= size / np.linalg.norm(inner, axis=2, keepdims=True)
    bias = size * np.linspace(-1.0, 1.0, hidden) * random.choice([-1.0, 1.0], size=(outputs, hidden))
    inner = np.concatenate([inner, bias[:, :, None]], axis=2)
    return np.concatenate([inner.reshape(outputs, -1), random.uniform(-1.0, 1.0, (outputs, hidden + 1))], axis=1)


def evaluate(weights: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return hidden units (r, n, hidden) and outputs (r, n) of networks with `weights` (r, P) at inputs x (n, f)."""
    hidden = (weights.shape[1] - 1) // (x.shape[1] + 2)
    inner = weights[:, : -hidden - 1].reshape(len(weights), hidden, -1)
    units = np.tanh(x @ inner[:, :, :-1].transpose(0, 2, 1) + inner[:, None, :, -1])
    return units, (units @ weights[:, -hidden - 1 : -1, None])[:, :, 0] + weights[:, -1:]


def linearise(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> GaussNewtonTerms:
    """Linearise the errors of networks with `weights` (r, P), for inputs x (n, f) and target outputs y (r, n)."""
    units, outputs = evaluate(weights, x)
    count, rows, hidden = units.shape
    lever = (1.0 - units**2) * weights[:, None, -hidden - 1 : -1]
    inner = lever[:, :, :, None] * np.column_stack([x, np.ones(rows)])[:, None, :]
    jacobian = np.concatenate([inner.reshape(count, rows, -1), units, np.ones((count, rows, 1))], axis=2)
    error, transposed = outputs - y, jacobian.transpose(0, 2, 1)
    return GaussNewtonTerms(
        transposed @ jacobian, (transposed @ error[:, :, None])[:, :, 0], np.square(error).sum(axis=1)
    )


def _compute_objective(weights: np.ndarray, error: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Compute the objective beta E_D + alpha E_W (r,) of each network."""
    return 0.5 * (beta * error + alpha * np.square(weights).sum(axis=1))


def take_damped_step(
    weights: np.ndarray,
    terms: GaussNewtonTerms,
    x: np.ndarray,
    y: np.ndarray,
    alpha: np.ndarray,
    beta: np.ndarray,
    damping: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take a Levenberg-Marquardt step of each network.

    Returns weights, relative gains and next damping. A network that no damping improves keeps its weights (gain 0).
    """
    weights, damping, gain = weights.copy(), damping.copy(), np.zeros(len(weights))
    before = _compute_objective(weights, terms.error, alpha, beta)
    descent = -(beta[:, None] * terms.gradient + alpha[:, None] * weights)
    active = np.arange(len(weights))
    while len(active):
        hessian = beta[active, None, None] * terms.hessian[active]
        hessian += (alpha + damping)[active, None, None] * np.eye(weights.shape[1])
        trial = weights[active] + solve_regularised(hessian, descent[active])
        error = np.square(evaluate(trial, x)[1] - y[active]).sum(axis=1)
        gained = 1.0 - _compute_objective(trial, error, alpha[active], beta[active]) / before[active]
        good = gained > 0.0
        weights[active[good]], gain[active[good]] = trial[good], gained[good]
        damping[active] *= np.where(good, DECREASE, INCREASE)
        active = active[~good & (damping[active] <= MAX_DAMPING)]
    return weights, gain, damping


def solve_regularised(matrix: np.ndarray, right_side: np.ndarray) -> np.ndarray:
    """Solve symmetric, positive semi-definite systems (r, P, P) for right-hand sides (r, P).

    With fewer rows than weights the fit can be exact: the estimated noise is then zero, and the damping vanishes in
    round-off. If any matrix is singular, a multiple of the identity at round-off level is added to each matrix.
    """
    try:
        return np.linalg.solve(matrix, right_side[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        count = matrix.shape[1]
        rounding = np.finfo(float).eps * count * np.trace(matrix, axis1=1, axis2=2)
        return np.linalg.solve(matrix + rounding[:, None, None] * np.eye(count), right_side[:, :, None])[:, :, 0]


def count_effective_weights(hessian: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Compute the effective number of weights (r,): the sum of l / (l + alpha) over the eigenvalues l of beta J^T J.

    MacKay 1992, "A practical Bayesian framework for backpropagation networks", Neural Comput. 4:448-472.
    """
    size = beta[:, None] * np.maximum(np.linalg.eigvalsh(hessian), 0.0)
    return np.sum(size / (size + alpha[:, None]), axis=1)


def estimate_precisions(
    weights: np.ndarray, error: np.ndarray, effective: np.ndarray, row_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate MacKay's alpha = gamma / (2 E_W) and beta = (n - gamma) / (2 E_D), (r,) each, gamma = `effective`."""
    spare = np.maximum(row_count - effective, 1.0)
    return effective / np.square(weights).sum(axis=1), spare / np.maximum(error, MIN_SQUARED_ERROR)

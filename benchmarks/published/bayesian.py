"""The published neural network: four hidden units per output, Levenberg-Marquardt, Bayesian regularisation."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from surrogate.regressors.protocol import Stored

# The damping of MATLAB's `trainbr`: the first, its factors after a good and a bad step, and where a network ends.
DAMPING, DOWN, UP, MOST_DAMPING = 5e-3, 0.1, 10.0, 1e10
# Least summed squared error, of outputs in [-1, 1], that differs from none.
NO_ERROR = 1e-20


@dataclass(eq=False)
class Bayesian(Stored):
    """One network of tanh units for each output; the evidence decides how much its weights are held back.

    Foresee, Hagan 1997, "Gauss-Newton approximation to Bayesian learning", ICNN 3:1930-1935. beta E_D + alpha E_W is
    lowered, with E_D and E_W half the sums of squared errors and weights. alpha and beta are set anew before every
    step. Made after the description of MATLAB's `trainbr`, which Tonutti, Gras, Yang 2017 used. It has features and
    outputs scaled to [-1, 1], first weights by Nguyen and Widrow's rule, the same damping, at most 1,000 steps. It
    differs in that a network also ends when a step gains less than `gain` of its objective, and in that all rows are
    trained on.

    Parameters
    ----------
    hidden
        Units of each network: 61 weights with 13 features.
    steps
        At most.
    gain
        Of the least step.
    seed
        Of the first weights.
    """

    kept = ("middle", "half", "offset", "scale", "weights")
    """Ranges of features and outputs, and the weights (r, P)."""
    hidden: int = 4
    steps: int = 1000
    gain: float = 1e-5
    seed: int = 0

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from rows X (n, f), Y (n, r)."""
        self.middle_, self.half_ = unit_range(X)
        self.offset_, self.scale_ = unit_range(Y)
        x, y = (X - self.middle_) / self.half_, ((Y - self.offset_) / self.scale_).T
        weights = first_weights(len(y), x.shape[1], self.hidden, np.random.default_rng(self.seed))
        terms = expansion(weights, x, y)
        # Every weight counts as determined by the data at first.
        alpha, beta = strengths(weights, terms.error, np.full(len(y), float(weights.shape[1])), len(x))
        damping = np.full(len(y), DAMPING)
        left = np.arange(len(y))
        for _ in range(self.steps):
            weights[left], gained, damping[left] = descended(
                weights[left], terms, x, y[left], alpha[left], beta[left], damping[left]
            )
            left = left[gained >= self.gain]
            if not len(left):
                break
            terms = expansion(weights[left], x, y[left])
            determined = well_determined(terms.curvature, alpha[left], beta[left])
            alpha[left], beta[left] = strengths(weights[left], terms.error, determined, len(x))
        self.weights_ = weights
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f)."""
        outputs = forward(self.weights_, (X - self.middle_) / self.half_)[1].T
        return (outputs * self.scale_ + self.offset_).astype(np.float32)


class Expansion(NamedTuple):
    """J^T J (r, P, P), J^T e (r, P) and e^T e (r,) of each network's errors e (n,) and their slopes J (n, P)."""

    curvature: np.ndarray
    slope: np.ndarray
    error: np.ndarray


def unit_range(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of the columns of `values` (n, f); a column that does not vary has the half width one."""
    low, high = values.min(axis=0), values.max(axis=0)
    half = 0.5 * (high - low)
    return 0.5 * (high + low), np.where(half > 1e-9 * np.maximum(np.abs(low), np.abs(high)), half, 1.0)


def first_weights(outputs: int, features: int, hidden: int, random: np.random.Generator) -> np.ndarray:
    """Weights (r, P) of `outputs` networks: hidden x (features and bias), then the output's.

    Nguyen, Widrow 1990, "Improving the learning speed of 2-layer neural networks", IJCNN 3:21-26.
    """
    inner = random.normal(size=(outputs, hidden, features))
    size = 0.7 * hidden ** (1.0 / features)
    inner *= size / np.linalg.norm(inner, axis=2, keepdims=True)
    bias = size * np.linspace(-1.0, 1.0, hidden) * random.choice([-1.0, 1.0], size=(outputs, hidden))
    inner = np.concatenate([inner, bias[:, :, None]], axis=2)
    return np.concatenate([inner.reshape(outputs, -1), random.uniform(-1.0, 1.0, (outputs, hidden + 1))], axis=1)


def forward(weights: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hidden units (r, n, hidden) and outputs (r, n) of the networks `weights` (r, P) at x (n, f)."""
    hidden = (weights.shape[1] - 1) // (x.shape[1] + 2)
    inner = weights[:, : -hidden - 1].reshape(len(weights), hidden, -1)
    units = np.tanh(x @ inner[:, :, :-1].transpose(0, 2, 1) + inner[:, None, :, -1])
    return units, (units @ weights[:, -hidden - 1 : -1, None])[:, :, 0] + weights[:, -1:]


def expansion(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> Expansion:
    """What Gauss and Newton need at `weights` (r, P), for y (r, n) at x (n, f)."""
    units, outputs = forward(weights, x)
    count, rows, hidden = units.shape
    lever = (1.0 - units**2) * weights[:, None, -hidden - 1 : -1]
    inner = lever[:, :, :, None] * np.column_stack([x, np.ones(rows)])[:, None, :]
    slopes = np.concatenate([inner.reshape(count, rows, -1), units, np.ones((count, rows, 1))], axis=2)
    error = outputs - y
    turned = slopes.transpose(0, 2, 1)
    return Expansion(turned @ slopes, (turned @ error[:, :, None])[:, :, 0], np.square(error).sum(axis=1))


def objective(weights: np.ndarray, error: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """beta E_D + alpha E_W (r,)."""
    return 0.5 * (beta * error + alpha * np.square(weights).sum(axis=1))


def descended(
    weights: np.ndarray,
    terms: Expansion,
    x: np.ndarray,
    y: np.ndarray,
    alpha: np.ndarray,
    beta: np.ndarray,
    damping: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A Levenberg-Marquardt step of each network: weights, share of its objective that it gained, next damping.

    A network that no damping helps stays as it is and gains nothing.
    """
    weights, damping, gained = weights.copy(), damping.copy(), np.zeros(len(weights))
    before = objective(weights, terms.error, alpha, beta)
    down = -(beta[:, None] * terms.slope + alpha[:, None] * weights)
    trying = np.arange(len(weights))
    while len(trying):
        held = beta[trying, None, None] * terms.curvature[trying]
        held += (alpha + damping)[trying, None, None] * np.eye(weights.shape[1])
        trial = weights[trying] + step(held, down[trying])
        error = np.square(forward(trial, x)[1] - y[trying]).sum(axis=1)
        gain = 1.0 - objective(trial, error, alpha[trying], beta[trying]) / before[trying]
        good = gain > 0.0
        weights[trying[good]], gained[trying[good]] = trial[good], gain[good]
        damping[trying] *= np.where(good, DOWN, UP)
        trying = trying[~good & (damping[trying] <= MOST_DAMPING)]
    return weights, gained, damping


def step(held: np.ndarray, down: np.ndarray) -> np.ndarray:
    """What solves symmetric, positive semi-definite systems (r, P, P) for right-hand sides (r, P).

    Fewer rows than weights may be matched exactly. Then noise counts as none, and damping is lost to rounding beside
    what the rows say. So all systems are held by as much as rounding is, and none is singular.
    """
    try:
        return np.linalg.solve(held, down[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        count = held.shape[1]
        rounding = np.finfo(float).eps * count * np.trace(held, axis1=1, axis2=2)
        return np.linalg.solve(held + rounding[:, None, None] * np.eye(count), down[:, :, None])[:, :, 0]


def well_determined(curvature: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """How many weights (r,) the data determine: the sum of l / (l + alpha), l the eigenvalues of beta J^T J.

    MacKay 1992, "A practical Bayesian framework for backpropagation networks", Neural Comput. 4:448-472.
    """
    size = beta[:, None] * np.maximum(np.linalg.eigvalsh(curvature), 0.0)
    return np.sum(size / (size + alpha[:, None]), axis=1)


def strengths(
    weights: np.ndarray, error: np.ndarray, determined: np.ndarray, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """MacKay's alpha and beta (r,), where the evidence is stationary: gamma / 2 E_W and (n - gamma) / 2 E_D."""
    spare = np.maximum(rows - determined, 1.0)
    return determined / np.square(weights).sum(axis=1), spare / np.maximum(error, NO_ERROR)

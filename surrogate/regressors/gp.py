"""Gaussian process regression from a load's features to the coefficients of a reduced basis."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve, get_lapack_funcs
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from sim.runtime.threads import limit_to_one_thread

from ..array_functions import compute_squared_distances
from .protocol import StoredRegressor, compute_standardisation

LENGTH_BOUNDS = (0.05, 1e3)  # Bounds of the length scales [standard deviations of a feature].
NOISE_BOUNDS = (1e-8, 1.0)  # Bounds of the noise relative to the variance of an output.
START_LENGTH = 3.0  # Initial length scale [standard deviations of a feature].
START_NOISE = 1e-4  # Initial noise relative to the variance of an output.


@dataclass(eq=False)
class Gp(StoredRegressor):
    """Gaussian process with a Matern 5/2 kernel and a length scale per feature; outputs share length scales and noise.

    Rasmussen, Williams 2006, "Gaussian Processes for Machine Learning", equations 2.25, 2.26, 4.17, 5.9. The
    hyperparameters maximise the likelihood of at most `likelihood_rows` rows and the `likelihood_outputs` strongest
    outputs. The process is conditioned on all rows, or on a random subset of `max_rows` rows.

    Parameters
    ----------
    likelihood_rows, max_rows
        Maximum numbers of rows in the likelihood and in the conditioning; the cost is cubic in both.
    likelihood_outputs
        Number of outputs in the likelihood: those of largest variance, each scaled to variance 1.
    seed
        Seed of the random subset of rows.
    """

    kept = ("mean", "deviation", "offset", "length", "noise", "scaled", "dual")
    """Standardisation, length scales (f,), noise, standardised training rows (n, f), dual coefficients (n, r)."""
    likelihood_rows: int = 600
    max_rows: int = 4000
    likelihood_outputs: int = 20
    seed: int = 0

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        vars(self).pop("seen_", None)
        order = np.random.default_rng(self.seed).permutation(len(X))[: self.max_rows]
        self.mean_, self.deviation_ = compute_standardisation(X)
        x = self.scaled_ = ((X - self.mean_) / self.deviation_)[order].astype(np.float32)
        self.offset_ = Y.mean(axis=0)
        y = (Y - self.offset_)[order]
        spread = y[: self.likelihood_rows].std(axis=0)
        loudest = np.argsort(-spread, kind="stable")[: self.likelihood_outputs]
        loudest = loudest[spread[loudest] > 0.0]
        start = np.log(np.append(np.full(X.shape[1], START_LENGTH), START_NOISE))
        if len(loudest):
            with limit_to_one_thread():
                fitted = minimize(
                    compute_negative_likelihood,
                    start,
                    args=(x[: self.likelihood_rows], y[: self.likelihood_rows, loudest] / spread[loudest]),
                    jac=True,
                    method="L-BFGS-B",
                    bounds=[*[tuple(np.log(LENGTH_BOUNDS))] * X.shape[1], tuple(np.log(NOISE_BOUNDS))],
                    options={"maxiter": 100},
                )
            start = fitted.x
        self.length_, self.noise_ = np.exp(start[:-1]), np.exp(start[-1])
        covariance = compute_matern(cdist(self.seen_, self.seen_))
        covariance.flat[:: len(covariance) + 1] += self.noise_
        self.dual_ = cho_solve(cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False), y)
        return self

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild from `state`; older files have rows divided by the length scales, `seen`."""
        known = dict(state)
        if "seen" in known:
            known["scaled"] = known.pop("seen") * known["length"]
        return super().restored(known)

    @cached_property
    def seen_(self) -> np.ndarray:
        """Standardised training rows (n, f), divided by the length scales."""
        return self.scaled_ / self.length_

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f): the posterior mean."""
        x = (X - self.mean_) / (self.deviation_ * self.length_)
        near = compute_matern(np.sqrt(compute_squared_distances(x, self.seen_)))
        return (near @ self.dual_ + self.offset_).astype(np.float32)


def compute_matern(distance: np.ndarray) -> np.ndarray:
    """Compute the kernel (1 + s + s^2/3) exp(-s) with s = sqrt(5) distance (equation 4.17)."""
    s = np.sqrt(5.0) * distance
    return (1.0 + s + s * s / 3.0) * np.exp(-s)


def compute_negative_likelihood(log: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Compute the negative log marginal likelihood of x (n, f), y (n, r), up to a constant, and its gradient (f + 1,).

    `log` (f + 1,) has the logarithms of the length scales and of the noise. Each output has its most likely variance,
    y^T K^-1 y / n, so that all outputs share one K.
    """
    count, outputs = y.shape
    u = x / np.exp(log[:-1])
    distance = cdist(u, u)
    covariance = compute_matern(distance)
    noise = np.exp(log[-1])
    covariance.flat[:: count + 1] += noise
    factor = cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
    dual = cho_solve(factor, y, check_finite=False)
    misfit = np.einsum("nr,nr->r", y, dual)
    value = 0.5 * count * np.log(misfit / count).sum() + outputs * np.log(np.diagonal(factor[0])).sum()
    # Derivative by K. Derivatives by hyperparameters are traces of its products with dK (equation 5.9).
    (inverted,) = get_lapack_funcs(("potri",), factor[:1])
    lower, _ = inverted(factor[0], lower=True)
    slope = outputs * (np.tril(lower) + np.tril(lower, -1).T)
    slope -= dual * (count / misfit) @ dual.T
    s = np.sqrt(5.0) * distance
    pull = slope * (5.0 / 3.0 * (1.0 + s) * np.exp(-s))  # dK / d log(length_j) = this x (u_ij - u_kj)^2
    by_length = np.einsum("i,if->f", pull.sum(axis=1), u * u) - np.einsum("if,if->f", u, pull @ u)
    return float(value), np.append(by_length, 0.5 * noise * np.trace(slope))

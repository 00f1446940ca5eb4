"""Support vector regression, one machine per mode of the reduced basis."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import numpy as np

from ..array_functions import squared_distances
from .protocol import Stored, standardisation


@dataclass(eq=False)
class Svr(Stored):
    """Gaussian kernel exp(-gamma |x - x'|^2), gamma = 1 / f, of standardised features.

    By default C = iqr(y) / 1.349 and epsilon = iqr(y) / 13.49 per output. These are MATLAB's defaults, which Tonutti,
    Gras, Yang 2017 used (Artif. Intell. Med. 80:39-47); they trained one machine per tumour node and component, which
    takes hours where one per mode takes seconds.

    Parameters
    ----------
    penalty, tube
        C and epsilon, in quartile ranges of the output.
    """

    kept = ("mean", "deviation", "support", "dual", "intercept")
    """Standardisation, support vectors (s, f), dual coefficients (s, r), intercepts (r,)."""
    penalty: float = 1.0 / 1.349
    tube: float = 1.0 / 13.49

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from rows X (n, f), Y (n, r)."""
        from sklearn.svm import SVR  # needed to fit, not to predict

        self.mean_, self.deviation_ = standardisation(X)
        scaled = (X - self.mean_) / self.deviation_
        spread = np.subtract(*np.percentile(Y, [75, 25], axis=0))
        dual = np.zeros((len(X), Y.shape[1]))
        intercept = np.zeros(Y.shape[1])

        def trained(mode: int) -> SVR:
            # In units of its quartile range an output meets libsvm's absolute stopping tolerance at any scale.
            return SVR(C=self.penalty, epsilon=self.tube, gamma=1.0 / X.shape[1]).fit(scaled, Y[:, mode] / spread[mode])

        modes = np.flatnonzero(spread > 0.0)
        with ThreadPoolExecutor() as pool:
            machines = list(pool.map(trained, modes))
        for mode, machine in zip(modes, machines, strict=True):
            dual[machine.support_, mode] = spread[mode] * machine.dual_coef_[0]
            intercept[mode] = spread[mode] * machine.intercept_[0]
        intercept[spread <= 0.0] = np.median(Y[:, spread <= 0.0], axis=0)
        used = np.flatnonzero(dual.any(axis=1))
        self.support_ = scaled[used].astype(np.float32)
        self.dual_ = dual[used].astype(np.float32)
        self.intercept_ = intercept.astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f)."""
        squared = squared_distances((X - self.mean_) / self.deviation_, self.support_)
        return (np.exp(squared / -len(self.mean_)) @ self.dual_ + self.intercept_).astype(np.float32)

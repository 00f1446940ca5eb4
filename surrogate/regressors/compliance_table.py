"""The compliance table: superposition of small-strain responses. The baseline that a learner must beat."""

from __future__ import annotations

from typing import Self

import numpy as np

from .protocol import Stored


class Linear(Stored):
    """Y = X C without intercept, C of least norm among the least-squares solutions.

    Trained with unit responses at the nodes it is the exact compliance table; with any other rows, its least-squares
    estimate.
    """

    kept = ("compliance",)
    """Its shape is (f, r)."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn C (f, r) from rows X (n, f), Y (n, r)."""
        self.compliance_ = np.linalg.lstsq(X, Y, rcond=1e-8)[0].astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """X C (B, r) float32."""
        return X.astype(np.float32) @ self.compliance_

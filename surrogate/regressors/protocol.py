"""Protocols of regressors, and the compliance matrix as the baseline regressor."""

from collections.abc import Mapping
from typing import ClassVar, Protocol, Self

import numpy as np


class FittedRegressor(Protocol):
    """Fitted map from features X (B, f) to coefficients Y (B, r)."""

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f)."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """Return the fitted state as plain arrays by name."""
        ...

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the fitted map from the arrays of `state`."""
        ...


class RegressorFactory(Protocol):
    """Factory of fitted maps: a regressor itself, or a selection among candidates."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> FittedRegressor:
        """Fit a map to features X (n, f) and coefficients Y (n, r); return the fitted map."""
        ...


class Regressor(FittedRegressor, Protocol):
    """Regressor that `fit` changes in place; fitted attributes end in an underscore."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        ...


def compute_standardisation(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute mean and standard deviation (f,) of each column of X (n, f); the deviation of a constant column is 1."""
    deviation = X.std(axis=0)
    return X.mean(axis=0), np.where(deviation > 1e-9 * np.abs(X).max(axis=0), deviation, 1.0)


class StoredRegressor:
    """Regressor whose state consists of the attributes named in `kept`, each with a trailing underscore."""

    kept: ClassVar[tuple[str, ...]]

    def state(self) -> dict[str, np.ndarray]:
        """Return the state: one array for each name in `kept`."""
        return {name: np.asarray(getattr(self, f"{name}_")) for name in self.kept}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from the arrays of `state`."""
        model = cls()
        for name, array in state.items():
            setattr(model, f"{name}_", array)
        return model


class Linear(StoredRegressor):
    """Linear map Y = X C without intercept; C is the least-squares solution of least norm.

    Fitted to unit responses at the nodes, C is the exact compliance matrix. Fitted to other rows, C is a least-squares
    estimate of it.
    """

    kept = ("compliance",)
    """Name of the state array: the compliance, of shape (f, r)."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit C (f, r) to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        self.compliance_ = np.linalg.lstsq(X, Y, rcond=1e-8)[0].astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Compute the product X C (B, r) float32."""
        return X.astype(np.float32) @ self.compliance_

"""Protocols of regressors, and the compliance matrix as the baseline of trained models."""

from collections.abc import Mapping
from typing import ClassVar, Protocol, Self

import numpy as np


class FittedRegressor(Protocol):
    """Map from features X (B, f) to coefficients Y (B, r)."""

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 of features (B, f)."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as plain arrays."""
        ...

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the map from `state`."""
        ...


class RegressorFactory(Protocol):
    """Factory of a fitted map: a regressor itself, or a selection among several."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> FittedRegressor:
        """Fit a map to rows X (n, f), Y (n, r)."""
        ...


class Regressor(FittedRegressor, Protocol):
    """Map that is fitted to rows. `fit` sets attributes that end in an underscore."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to rows X (n, f), Y (n, r)."""
        ...


def compute_standardisation(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute mean and deviation (f,) of the columns of X (n, f); a constant column has the deviation one."""
    deviation = X.std(axis=0)
    return X.mean(axis=0), np.where(deviation > 1e-9 * np.abs(X).max(axis=0), deviation, 1.0)


class StoredRegressor:
    """Regressor whose state is its attributes of the names in `kept`, each with a trailing underscore."""

    kept: ClassVar[tuple[str, ...]]

    def state(self) -> dict[str, np.ndarray]:
        """Return the state: an array for each name in `kept`."""
        return {name: np.asarray(getattr(self, f"{name}_")) for name in self.kept}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from `state`."""
        model = cls()
        for name, array in state.items():
            setattr(model, f"{name}_", array)
        return model


class Linear(StoredRegressor):
    """Y = X C without intercept, C of least norm among the least-squares solutions.

    Fitted to unit responses at the nodes it is the exact compliance matrix; with any other rows, its least-squares
    estimate.
    """

    kept = ("compliance",)
    """The compliance has shape (f, r)."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit C (f, r) to rows X (n, f), Y (n, r)."""
        self.compliance_ = np.linalg.lstsq(X, Y, rcond=1e-8)[0].astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Compute X C (B, r) float32."""
        return X.astype(np.float32) @ self.compliance_

"""Protocols of regressors, and the compliance matrix as the baseline that a learner must beat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Protocol, Self

import numpy as np


class Fitted(Protocol):
    """A map from features X (B, f) to coefficients Y (B, r)."""

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f)."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """What it knows, as plain arrays."""
        ...

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """The one that `state` came from."""
        ...


class Teachable(Protocol):
    """What makes a map of rows: a regressor itself, or what chooses one."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Fitted:
        """The map learnt from rows X (n, f), Y (n, r)."""
        ...


class Regressor(Fitted, Protocol):
    """A map that is learnt from rows. `fit` sets attributes that end in an underscore."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from rows X (n, f), Y (n, r)."""
        ...


def standardisation(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation (f,) of the columns of X (n, f); a column that does not vary has the deviation one."""
    deviation = X.std(axis=0)
    return X.mean(axis=0), np.where(deviation > 1e-9 * np.abs(X).max(axis=0), deviation, 1.0)


class Stored:
    """A regressor whose state is its attributes of the names in `kept`, each with an underscore behind."""

    kept: ClassVar[tuple[str, ...]]

    def state(self) -> dict[str, np.ndarray]:
        """What is stored: an array for each name in `kept`."""
        return {name: np.asarray(getattr(self, f"{name}_")) for name in self.kept}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`."""
        model = cls()
        for name, array in state.items():
            setattr(model, f"{name}_", array)
        return model


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

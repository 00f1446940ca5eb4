"""What every learner is: features in, coefficients out, in the shape of scikit-learn."""

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

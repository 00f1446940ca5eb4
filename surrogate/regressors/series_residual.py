"""What a power series to the third order leaves over: small where the force is, and learned."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np

from .force_series import ORDERS
from .gp import Gp

# Share of the largest training force, below which the remainder is smaller than the table's own errors.
FAINT = 0.4
# What the process's dual coefficients are rounded to [m], at the largest force: a file then takes a third of the bytes.
DUAL_STEP = 2e-6
# Those of `tool_features`, and force over radius.
FEATURES = 9


class Remainder:
    """A Gaussian process of the response's remainder in units of force^3 + faint^3.

    The first neglected order goes with force^3, so that the rows of strong loads weigh no more than those of weak ones.
    Its features are `tool_features` and force over radius, to which indentation is in proportion.
    """

    gp_: Gp
    faint_: np.ndarray

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from `tool_features` X (n, 8) and remainders Y (n, r)."""
        self.faint_ = np.array(FAINT * X[:, 6].max())
        self.gp_ = Gp().fit(with_pressing(X), Y / self._unit(X))
        strongest = X[[X[:, 6].argmax()]]
        step = np.exp2(np.floor(np.log2(DUAL_STEP / (strongest[0, 6] * self._unit(strongest).item()))))
        self.gp_.dual_ = (np.rint(self.gp_.dual_ / step) * step).astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of `tool_features` (B, 8)."""
        return (self.gp_.predict(with_pressing(X)) * self._unit(X)).astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """The process's, and `faint` [N]."""
        return {**self.gp_.state(), "faint": self.faint_}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`."""
        model = cls()
        model.faint_ = state["faint"]
        model.gp_ = Gp.restored({name: array for name, array in state.items() if name != "faint"})
        return model

    def _unit(self, X: np.ndarray) -> np.ndarray:
        """(n, 1) [N^3]."""
        return X[:, 6:7] ** ORDERS + self.faint_**ORDERS


def with_pressing(X: np.ndarray) -> np.ndarray:
    """`tool_features` (n, 8), and force over radius: (n, 9)."""
    return np.column_stack([X, X[:, 6] / X[:, 7]])

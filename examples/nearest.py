"""A learner of one's own: the mean of the nearest loads, each weighted by how near it is.

Train it by `sulcus train DATA.h5 --out MODEL.npz --plugin nearest.py --learners nearest`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np

from surrogate import register_learner
from surrogate.regressors.protocol import compute_standardisation

NEIGHBOURS = 8


@register_learner("nearest")
class Nearest:
    """Inverse squared distances among standardised features. `fit` sets attributes that end in an underscore."""

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Keep rows X (n, f), Y (n, r)."""
        self.mean_, self.deviation_ = compute_standardisation(X)
        self.X_, self.Y_ = (X - self.mean_) / self.deviation_, Y
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) of features (B, f)."""
        apart = ((((X - self.mean_) / self.deviation_)[:, None] - self.X_) ** 2).sum(axis=2)
        near = np.argsort(apart, axis=1)[:, :NEIGHBOURS]
        weight = 1.0 / (np.take_along_axis(apart, near, axis=1) + 1e-6)
        weight /= weight.sum(axis=1, keepdims=True)
        return np.einsum("bk,bkr->br", weight, self.Y_[near]).astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as plain arrays: a model file stores nothing else."""
        return {"mean": self.mean_, "deviation": self.deviation_, "X": self.X_, "Y": self.Y_}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from `state`."""
        model = cls()
        model.mean_, model.deviation_, model.X_, model.Y_ = (state[name] for name in ("mean", "deviation", "X", "Y"))
        return model

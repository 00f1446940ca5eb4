"""Principal-component regression: the plain baseline of data-driven models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from .protocol import Stored

# A component smaller than this against the largest is rounding.
RANK = 1e-9


@dataclass(eq=False)
class Pcr(Stored):
    """Least squares on the principal components of the features, with intercept.

    Jolliffe 2002, "Principal Component Analysis", chapter 8. The features are taken as they are: give such as share one
    unit (forces at the nodes). Components are kept until `share` of the features' variance is: the rest would be fitted
    to places that few loads touch.

    Parameters
    ----------
    share
        Of the variance, in (0, 1].
    """

    kept = ("mean", "map", "offset")
    """Mean of the features (f,), map (f, r), offset (r,)."""
    share: float = 0.999

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from rows X (n, f), Y (n, r)."""
        self.mean_, self.offset_ = X.mean(axis=0), Y.mean(axis=0)
        components, size, axes = np.linalg.svd(X - self.mean_, full_matrices=False)
        kept = 1 + int(np.searchsorted(np.cumsum(size**2), self.share * np.sum(size**2)))
        kept = min(kept, int(np.sum(size > RANK * size[0])))
        # Components are orthogonal: each has its own least squares.
        slopes = components[:, :kept].T @ (Y - self.offset_) / size[:kept, None]
        self.map_ = axes[:kept].T @ slopes
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f)."""
        return ((X - self.mean_) @ self.map_ + self.offset_).astype(np.float32)

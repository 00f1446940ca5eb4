"""Least, greatest, mean and deviation of numbers that come in blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Spread:
    """Of `count` rows: each a float64 array of one row's shape. What is not known, NaN, counts nowhere."""

    least: np.ndarray
    greatest: np.ndarray
    total: np.ndarray
    squares: np.ndarray
    known: np.ndarray
    count: int

    @classmethod
    def of(cls, rows: np.ndarray) -> Spread:
        """Of rows (T, ...)."""
        rows = np.asarray(rows, np.float64)
        known = ~np.isnan(rows)
        filled = np.where(known, rows, 0.0)
        return cls(
            np.where(known, rows, np.inf).min(axis=0),
            np.where(known, rows, -np.inf).max(axis=0),
            filled.sum(axis=0),
            np.square(filled).sum(axis=0),
            known.sum(axis=0),
            len(rows),
        )

    def __add__(self, other: Spread) -> Spread:
        """Of both."""
        return Spread(
            np.minimum(self.least, other.least),
            np.maximum(self.greatest, other.greatest),
            self.total + other.total,
            self.squares + other.squares,
            self.known + other.known,
            self.count + other.count,
        )

    def said(self) -> dict[str, list]:
        """As lists: min, max, mean, std and count; zeros where nothing is known."""
        known = np.maximum(self.known, 1)
        mean = self.total / known
        deviation = np.sqrt(np.maximum(self.squares / known - np.square(mean), 0.0))
        arrays = {"min": self.least, "max": self.greatest, "mean": mean, "std": deviation}
        lists = {name: np.where(self.known, array, 0.0) for name, array in arrays.items()}
        return {**{name: np.atleast_1d(array).tolist() for name, array in lists.items()}, "count": [self.count]}

"""Array functions that NumPy lacks. Other array types, such as `Tensor` of ONNX graphs, register their own versions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, singledispatch
from typing import Self

import numpy as np


@singledispatch
def compute_squared_distances(points: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """Compute the squared distances (B, n) between each of `points` (B, f) and each of `sites` (n, f)."""
    from scipy.spatial.distance import cdist  # import takes a tenth of a second; help texts do not need it

    return cdist(points, sites, "sqeuclidean")


@dataclass(frozen=True, eq=False)
class QuantisedTable:
    """Table (n, r) stored as integers times a step size, which takes less space in a file than float32.

    Parameters
    ----------
    integers
        Values (n, r) int16 in multiples of `step`, stored column by column, as similar neighbours compress better.
    step
        Step sizes (r,) float32, in the table's unit.
    """

    integers: np.ndarray
    step: np.ndarray

    @classmethod
    def quantise(cls, table: np.ndarray, step: np.ndarray | float) -> Self:
        """Round a table (n, r) to multiples of `step`, () or (r,); larger steps are used where int16 would overflow."""
        largest = np.abs(table).max(axis=0, initial=0.0) / np.iinfo(np.int16).max
        step = np.maximum(np.broadcast_to(step, largest.shape), largest).astype(np.float32)
        return cls(np.rint(table / step).astype(np.int16, order="F"), step)

    @cached_property
    def values(self) -> np.ndarray:
        """Table (n, r) float32 with the step sizes applied."""
        return np.multiply(self.integers, self.step, order="C", dtype=np.float32)


def round_to_half(table: np.ndarray) -> np.ndarray:
    """Round a table of any range to the 11 significant bits of half precision; return float32, which compresses better.

    The relative change is at most 1 in 2,000.
    """
    share, exponent = np.frexp(table)
    return np.ldexp(np.rint(share * 2048.0) / 2048.0, exponent).astype(np.float32)


@singledispatch
def take_rows(index: np.ndarray, table: np.ndarray | QuantisedTable) -> np.ndarray:
    """Return the rows of a table (n, ...) at an integer `index` of any shape: `table[index]`."""
    return (table.values if isinstance(table, QuantisedTable) else table)[index]


@singledispatch
def multiply_rows(rows: np.ndarray, table: QuantisedTable, index: np.ndarray) -> np.ndarray:
    """Multiply the matrix `rows` (B, k) by the k rows of a table (n, r) that `index` (k,) selects; return (B, r)."""
    return rows @ table.values[index]


@singledispatch
def find_nonzero_columns(rows: np.ndarray) -> np.ndarray:
    """Return the ascending numbers of the columns of `rows` (B, n) that have a nonzero entry."""
    return np.flatnonzero(rows.any(axis=0))


def predict_in_chunks(predict: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, max_rows: int = 64) -> np.ndarray:
    """Apply `predict` to `rows` (B, f), at most `max_rows` rows at a time to limit memory; return all predictions."""
    if len(rows) <= max_rows:
        return predict(rows)
    return np.concatenate([predict(rows[first : first + max_rows]) for first in range(0, len(rows), max_rows)])

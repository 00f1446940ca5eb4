"""Array functions that NumPy lacks. Other array types, such as `Tensor` of ONNX graphs, register their own versions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, singledispatch
from typing import Self

import numpy as np


@singledispatch
def compute_squared_distances(points: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """Compute squared distances (B, n) of points (B, f) from sites (n, f)."""
    from scipy.spatial.distance import cdist  # import takes a tenth of a second; help texts do not need it

    return cdist(points, sites, "sqeuclidean")


@dataclass(frozen=True, eq=False)
class QuantisedTable:
    """Table (n, r) of whole numbers of steps, which takes a fraction of a file's bytes.

    Parameters
    ----------
    integers
        Numbers of steps (n, r) int16, column by column: similar numbers next to each other compress better.
    step
        Step sizes (r,) float32, in the table's unit.
    """

    integers: np.ndarray
    step: np.ndarray

    @classmethod
    def quantise(cls, table: np.ndarray, step: np.ndarray | float) -> Self:
        """Round a table (n, r) to a step, or steps (r,); larger ones if the numbers exceed int16."""
        largest = np.abs(table).max(axis=0, initial=0.0) / np.iinfo(np.int16).max
        step = np.maximum(np.broadcast_to(step, largest.shape), largest).astype(np.float32)
        return cls(np.rint(table / step).astype(np.int16, order="F"), step)

    @cached_property
    def values(self) -> np.ndarray:
        """Table (n, r) float32."""
        return np.multiply(self.integers, self.step, order="C", dtype=np.float32)


def round_to_half(table: np.ndarray) -> np.ndarray:
    """Round numbers of any size to the 11 significant bits of half precision, as float32: a file takes half the bytes.

    The relative change is at most 1 in 2,000.
    """
    share, exponent = np.frexp(table)
    return np.ldexp(np.rint(share * 2048.0) / 2048.0, exponent).astype(np.float32)


@singledispatch
def take_rows(index: np.ndarray, table: np.ndarray | QuantisedTable) -> np.ndarray:
    """Return rows of a table (n, ...) at whole numbers of any shape: `table[index]`."""
    return (table.values if isinstance(table, QuantisedTable) else table)[index]


@singledispatch
def multiply_rows(rows: np.ndarray, table: QuantisedTable, index: np.ndarray) -> np.ndarray:
    """Multiply rows (B, k) by the rows of a table (n, r) at an index (k,)."""
    return rows @ table.values[index]


@singledispatch
def find_nonzero_columns(rows: np.ndarray) -> np.ndarray:
    """Return the columns of rows (B, n) that are not all zero, ascending."""
    return np.flatnonzero(rows.any(axis=0))


def predict_in_chunks(predict: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, max_rows: int = 64) -> np.ndarray:
    """Predict rows (B, f) in chunks of at most `max_rows` rows, to limit memory."""
    if len(rows) <= max_rows:
        return predict(rows)
    return np.concatenate([predict(rows[first : first + max_rows]) for first in range(0, len(rows), max_rows)])

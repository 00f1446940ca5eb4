"""Array functions that NumPy lacks. A type of array registers its own version, as graphs do for export."""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch

import numpy as np


@singledispatch
def squared_distances(points: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """Squared distances (B, n) of points (B, f) from sites (n, f)."""
    from scipy.spatial.distance import cdist  # takes a tenth of a second, and help texts need none of it

    return cdist(points, sites, "sqeuclidean")


@singledispatch
def taken(index: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Rows of a table (n, ...) at whole numbers of any shape: `table[index]`."""
    return table[index]


@singledispatch
def product_of(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """rows (B, n) @ table (n, r)."""
    return rows @ table


@singledispatch
def columns_in_use(rows: np.ndarray) -> np.ndarray:
    """The columns of rows (B, n) that are not all zero, ascending."""
    return np.flatnonzero(rows.any(axis=0))


def in_chunks(predicted: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, most: int = 64) -> np.ndarray:
    """What is predicted of rows (B, f), at most so many at a time: bounds the memory that it takes."""
    if len(rows) <= most:
        return predicted(rows)
    return np.concatenate([predicted(rows[first : first + most]) for first in range(0, len(rows), most)])


def halved(table: np.ndarray, axes: int | tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A table in half precision: units, its largest numbers along some axes, and shares of them (float16)."""
    unit = np.abs(table).max(axis=axes, initial=0.0) + np.finfo(np.float32).tiny
    return unit, (table / unit).astype(np.float16)

"""Array functions that NumPy lacks. A type of array registers its own version, as graphs do for export."""

from __future__ import annotations

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

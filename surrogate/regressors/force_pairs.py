"""The second order in the nodal forces, a row for each pair of them: what needs neither learning nor interpolation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from ..array_functions import Rounded, columns_in_use, in_chunks, product_of


@dataclass(frozen=True, eq=False)
class Pairs:
    """A regressor that predicts what the second order adds to the response, from `rooted_shares`.

    Parameters
    ----------
    pairs
        (P, 2): two force components, of the nodes of the open cortex.
    table
        (P, r): coefficients of the basis's modes for each pair's product [1/N^2].
    """

    pairs: np.ndarray
    table: Rounded

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of `rooted_shares` (B, 3 m)."""
        return in_chunks(self._predicted, X)

    def _predicted(self, X: np.ndarray) -> np.ndarray:
        used = columns_in_use(X)
        row = self._rows[used[:, None], used]
        row = row[row >= 0]
        first, second = self.pairs[row].T
        return product_of((X[:, first] * X[:, second]).astype(np.float32), self.table, row)

    @cached_property
    def _rows(self) -> np.ndarray:
        """The row (n, n) int32 of each pair of components, or -1."""
        out = np.full((self.pairs.max(initial=-1) + 1,) * 2, -1, np.int32)
        out[self.pairs[:, 0], self.pairs[:, 1]] = np.arange(len(self.pairs))
        return out

    def state(self) -> dict[str, np.ndarray]:
        """Pairs, and the table: whole numbers of steps, `share`, and the step of each mode, `unit`."""
        return {"pairs": self.pairs.astype(np.int32), "unit": self.table.step, "share": self.table.whole}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`; files of earlier versions have float16 in place of whole numbers."""
        return cls(state["pairs"], Rounded(state["share"], state["unit"]))

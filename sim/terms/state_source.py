"""Interface of sources of law coefficients that vary between quadrature points and load cases."""

from typing import Protocol

import numpy as np
import warp as wp

from ..discretisation.term import Cases
from .laws.law import Law


class StateSource(Protocol):
    """Interface of sources of coefficients that vary between points and load cases, and of the law that uses these.

    Coefficients are in a Warp array (T, q, n, b) of the device's scalar type: element, point, coefficient, load case.
    """

    @property
    def count(self) -> int:
        """Number of coefficients per point."""
        ...

    @property
    def width(self) -> int:
        """Number of history variables per point that `end` returns."""
        ...

    def build_law(self, base_law: Law, count: int) -> Law:
        """Return a law based on `base_law`, with its `count` coefficients followed by those of the source."""
        ...

    def fill(self, cases: Cases, first_index: int, out: wp.array) -> None:
        """Write the coefficients of the load cases to out (T, q, n, b), from the coefficient index `first_index`."""
        ...

    def end(self, cases: Cases, strains: wp.array) -> np.ndarray | None:
        """Return the history variables (B, ...), or None; `strains` (T, q, b) are the current displacement gradients.

        A source that causes a part of the strains removes this part in place, before inner sources use the strains.
        """
        ...

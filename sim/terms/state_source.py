"""Interface of coefficients that a law takes per quadrature point and load case."""

from typing import Protocol

import numpy as np
import warp as wp

from ..discretisation.term import Cases
from .laws.law import Law


class StateSource(Protocol):
    """Source of coefficients that vary between points and load cases, and of the law that uses them.

    Coefficients are a Warp array (T, q, n, b) in the device's scalar type: element, point, coefficient, load case.
    """

    @property
    def count(self) -> int:
        """Number of coefficients per point."""
        ...

    @property
    def width(self) -> int:
        """Number of values per point in the memory that `end` returns."""
        ...

    def build_law(self, inner: Law, count: int) -> Law:
        """Wrap `inner`, a law of `count` coefficients, in a law that takes these first and then the source's."""
        ...

    def fill(self, cases: Cases, first: int, out: wp.array) -> None:
        """Write the coefficients of these cases to out (T, q, n, b), from index `first`."""
        ...

    def end(self, cases: Cases, strains: wp.array) -> np.ndarray | None:
        """Return the memory (B, ...) for the next call, or None; strains (T, q, b) are current displacement gradients.

        A source that explains a part of the strains removes it in place, before the sources inside it see them.
        """
        ...

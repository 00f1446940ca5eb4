"""What a law may take at every point in every load case beside its element's coefficients."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp

from ..discretisation.term import Cases
from .laws.law import Law


class StateSource(Protocol):
    """Numbers that vary from point to point and from case to case, and the law that takes them.

    Numbers are Warp's (T, q, n, b) in the device's scalar type: element, point, number, column.
    """

    @property
    def count(self) -> int:
        """How many there are at a point."""
        ...

    @property
    def width(self) -> int:
        """How many numbers of each point must travel, as `end` has them."""
        ...

    def law(self, inner: Law, count: int) -> Law:
        """The law that `inner`, which takes `count` numbers, becomes: it takes these first, and then the source's."""
        ...

    def fill(self, cases: Cases, first: int, out: wp.array) -> None:
        """Write the numbers of these cases to out (T, q, n, b), from number `first` on."""
        ...

    def end(self, cases: Cases, strains: wp.array) -> np.ndarray | None:
        """What must travel to the next call (B, ...), or None; strains (T, q, b): the displacement gradients now.

        A source that accounts for some of them leaves the rest there: those inside of it come after it.
        """
        ...

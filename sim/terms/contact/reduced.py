"""The barrier of tools on the nodes that they can touch, of one column, on the host in double precision.

What is solved with it is small: arrays travel no farther than from NumPy to a kernel on the CPU.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp

from ...discretisation.term import Term
from ...runtime.device import Device

HOST = Device("cpu", "float64")


class Dense(Term, Protocol):
    """A Term that few nodes feel, so that its curvature is a small dense matrix."""

    def add_matrix(self, u: wp.array, place: wp.array, definite: bool, out: wp.array) -> None:
        """Add K(u) of one column, u (3N, 1), to out (3n, 3n), float64, between nodes of a `place` (N,), not -1."""
        ...


class Reduced:
    """A `Reduction`.

    Parameters
    ----------
    term
        The barrier of these n nodes alone, on the `HOST`.
    count
        n.
    """

    def __init__(self, term: Dense, count: int):
        self._term = term
        # Arrays of Warp and the same numbers as NumPy's: to make either anew takes as long as a launch.
        self._at, self._way, self._force = (HOST.zeros(3 * count, 1) for _ in range(3))
        self._place, self._bound = wp.zeros(count, dtype=wp.int32, device="cpu"), HOST.zeros(1)
        self._w, self._dw, self._f = (array.numpy()[:, 0] for array in (self._at, self._way, self._force))
        self._numbers, self._longest = self._place.numpy(), self._bound.numpy()

    def slope(self, w: np.ndarray) -> np.ndarray:
        """As `Reduction.slope`."""
        self._w[:], self._f[:] = w, 0.0
        self._term.add_gradient(self._at, self._force)
        return self._f.copy()

    def curvature(self, w: np.ndarray, some: np.ndarray, definite: bool) -> np.ndarray:
        """As `Reduction.curvature`."""
        self._w[:], self._numbers[:] = w, -1
        self._numbers[some] = np.arange(len(some))
        out = wp.zeros((3 * len(some), 3 * len(some)), dtype=wp.float64, device="cpu")
        self._term.add_matrix(self._at, self._place, definite, out)
        return out.numpy()

    def longest_step(self, w: np.ndarray, dw: np.ndarray) -> float:
        """As `Reduction.longest_step`."""
        self._w[:], self._dw[:], self._longest[0] = w, dw, 1.0
        self._term.longest_step(self._at, self._way, self._bound)
        return float(self._longest[0])

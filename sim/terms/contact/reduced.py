"""The barrier of tools on the nodes that they can touch, in double precision."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import warp as wp

from ...discretisation.term import Term
from ...runtime.device import Device
from ...runtime.views import view


class Dense(Term, Protocol):
    """A Term that few nodes feel, so that its curvature is a small dense matrix."""

    def add_matrix(self, u: wp.array, definite: wp.array, place: wp.array, out: wp.array) -> None:
        """Add K(u) of b columns, u (3N, b), to out (b, 3m, 3m), float64, between nodes of a `place` (N, b), not -1."""
        ...


class Reduced:
    """A `Reduction`.

    Parameters
    ----------
    term
        The barrier of these n nodes alone, in double precision.
    count
        n.
    device
        Where it lives.
    """

    def __init__(self, term: Dense, count: int, device: Device):
        self._term, self._count, self._device = term, count, device
        # To make an array takes as long as a launch.
        self._arrays = lru_cache(2)(self._made)

    def keep(self, columns: np.ndarray) -> None:
        """As `Reduction.keep`."""
        self._term.keep(columns)

    def slope(self, w: Any) -> Any:
        """As `Reduction.slope`."""
        at, force = self._arrays(w.shape[1])[:2]
        view(at)[:] = w
        force.zero_()
        self._term.add_gradient(at, force)
        return view(force) + 0.0  # a copy

    def curvature(self, w: Any, place: Any, size: int, definite: np.ndarray) -> Any:
        """As `Reduction.curvature`."""
        at, _, _, numbers = self._arrays(w.shape[1])
        view(at)[:], view(numbers)[:] = w, place
        out = wp.zeros((w.shape[1], 3 * size, 3 * size), dtype=wp.float64, device=self._device.name)
        self._term.add_matrix(at, self._device.array(definite.astype(np.int32), wp.int32), numbers, out)
        return view(out)

    def longest_step(self, w: Any, dw: Any) -> np.ndarray:
        """As `Reduction.longest_step`."""
        at, _, way, _ = self._arrays(w.shape[1])
        view(at)[:], view(way)[:] = w, dw
        bound = wp.full(w.shape[1], 1.0, dtype=wp.float64, device=self._device.name)
        self._term.longest_step(at, way, bound)
        return bound.numpy()

    def _made(self, columns: int) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """Places, forces and motions (3n, b), and numbers (n, b)."""
        at, force, way = (self._device.zeros(3 * self._count, columns) for _ in range(3))
        return at, force, way, wp.zeros((self._count, columns), dtype=wp.int32, device=self._device.name)

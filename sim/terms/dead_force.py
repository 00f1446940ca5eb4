"""Forces that keep size and direction while the tissue moves: nodal forces, and tractions on a footprint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ..columns import add_dots, combined, gathered
from ..device import Device
from ..loads import Loads
from ..term import Cases


class DeadForce:
    """A Term: E = -f . u, with f (3N, b) [N] assembled from the loads once a batch.

    Parameters
    ----------
    name
        Unique in its problem.
    assemble
        Loads -> nodal forces (3N, B) [N].
    device
        Where its arrays live.
    """

    def __init__(self, name: str, assemble: Callable[[Loads], np.ndarray], device: Device):
        self.name = name
        self._assemble = assemble
        self._device = device
        self._force = device.zeros(0, 0)

    def begin(self, cases: Cases) -> None:
        """Assemble the nodal forces of every column."""
        self._force = self._device.array(self._assemble(cases.loads))

    def keep(self, columns: np.ndarray) -> None:
        """Drop the forces of the others."""
        self._force = gathered(self._device, self._force, columns)

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E -= f . u."""
        dot = wp.zeros(u.shape[1], dtype=wp.float64, device=self._device.name)
        add_dots(self._device, self._force, u, dot)
        out.assign(out.numpy() - dot.numpy())

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """g -= f."""
        combined(self._device, out, np.full(u.shape[1], -1.0), self._force, out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """A dead force has no curvature."""

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """A dead force has no curvature."""

    def add_diagonal(self, out: wp.array) -> None:
        """A dead force has no curvature."""

    def rest_curvature(self) -> None:
        """A dead force has no curvature."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """A dead force allows every step."""

    def end(self, u: wp.array) -> None:
        """A dead force remembers nothing."""

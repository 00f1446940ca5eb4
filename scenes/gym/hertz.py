"""A ball on an elastic half space, as Hertz has it: 1882, J. reine angew. Math. 92:156-171."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sim.material import Tissue


@dataclass(frozen=True)
class Hertz:
    """Forces, depths and pressures of a ball without friction.

    Parameters
    ----------
    radius
        Of the ball [m].
    tissue
        Of the half space; what counts is its stiffness at small strains.
    """

    radius: float
    tissue: Tissue

    @cached_property
    def modulus(self) -> float:
        """E / (1 - nu^2) [Pa], which is 2 mu / (1 - nu)."""
        mu, lame = self.tissue.lame
        return 2.0 * mu / (1.0 - 0.5 * lame / (lame + mu))

    def force(self, depth: np.ndarray) -> np.ndarray:
        """Forces [N] at depths [m]: F = 4/3 E' sqrt(r) d^1.5; none above the surface."""
        return 4.0 / 3.0 * self.modulus * np.sqrt(self.radius) * np.maximum(depth, 0.0) ** 1.5

    def contact(self, force: np.ndarray) -> np.ndarray:
        """Radii of contact [m] under forces [N]: a^3 = 3 F r / (4 E')."""
        return np.cbrt(0.75 * force * self.radius / self.modulus)

    def pressure(self, force: float) -> float:
        """The pressure [Pa] in the middle of the contact under a force [N]: 3 F / (2 pi a^2)."""
        return 1.5 * force / (np.pi * float(self.contact(np.array(force))) ** 2) if force > 0.0 else 0.0

    def deeper(self, force: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """How much deeper [m] the ball's middle is than that of a wider footprint (k,) [m] under the same forces (k,).

        The middle of a footprint sqrt(1 - (s/a)^2) sinks by 3 F / (4 E' a).
        """
        own = np.where(force > 0.0, self.contact(force), 1.0)
        return 0.75 * force / self.modulus * (1.0 / own - 1.0 / footprint)

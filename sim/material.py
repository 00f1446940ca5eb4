"""Tissue laws as descriptions, and the only conversion of (E, nu) to coefficients in the house."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import InputError


@dataclass(frozen=True)
class Material:
    """A tissue law by name with its engineering constants.

    Parameters
    ----------
    law
        One of `LAWS`.
    young
        Young's modulus at small strain [Pa].
    poisson
        Poisson's ratio at small strain, -1 < nu < 0.5.

    Raises
    ------
    InputError
        Unknown law, E <= 0, nu outside (-1, 0.5).
    """

    law: str
    young: float
    poisson: float

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise InputError(f"no tissue law is called {self.law!r}: choose one of {', '.join(LAWS)}.")
        if not (np.isfinite(self.young) and self.young > 0.0):
            raise InputError(f"Young's modulus is {self.young} Pa: give a positive number.")
        if not -1.0 < self.poisson < 0.5:
            raise InputError(
                f"Poisson's ratio is {self.poisson}: give a number in (-1, 0.5); "
                "for nearly incompressible tissue, 0.49 or 0.4999."
            )

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa]: mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu)(1 - 2 nu))."""
        mu = self.young / (2.0 * (1.0 + self.poisson))
        return mu, self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))


LAWS = ("linear", "corotational", "neo-hookean", "stable-neo-hookean")

BRAIN = Material("stable-neo-hookean", 3000.0, 0.45)
"""The default tissue: stable under every load, and linear tetrahedra lock little at nu = 0.45."""

MATERIALS = {
    "default": BRAIN,
    # Tonutti, Gras, Yang 2017, Artif. Intell. Med. 80:39-47: small-strain equivalent of their two-term Ogden.
    "seed": Material("neo-hookean", 3330.0, 0.4945),
    # Time scale of seconds: what a pressing tool meets.
    "seconds": Material("neo-hookean", 3000.0, 0.49),
}

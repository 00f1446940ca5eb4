"""A tissue law of one's own: Yeoh's, which stiffens as it is stretched.

    psi = c1 (I - 3) + c2 (I - 3)^2 + K/2 (ln J)^2,  I = J^(-2/3) tr F^T F

Yeoh 1990, "Characterization of elastic properties of carbon-black-filled rubber vulcanizates", Rubber Chem. Technol.
63:792-805, with a volumetric part. Run this file to hold the law to what the solver asks of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from sim import Law
from sim.terms.laws.invariants import cofactor_excess, exp_less_one, green_strain, log_one_plus, volume_change


@wp.func
def inverse_transpose(H: Any):
    """F^-T of F = I + H."""
    one = type(H[0, 0])(1.0)
    return (wp.identity(n=3, dtype=type(one)) + cofactor_excess(H)) / (one + volume_change(H))


@wp.func
def isochoric_excess(H: Any):
    """I - 3, in strains, so that nothing of the size of 3 cancels."""
    two, three = type(H[0, 0])(2.0), type(H[0, 0])(3.0)
    strain = two * wp.trace(green_strain(H))
    return strain + exp_less_one(-two / three * log_one_plus(volume_change(H))) * (three + strain)


@wp.func
def energy(H: Any, c: Any):
    """psi [Pa] of c = (c1, c2, K) [Pa]; +inf where J <= 0."""
    j = volume_change(H)
    if j <= -type(j)(1.0):
        return type(j)(wp.inf)
    excess, log_J = isochoric_excess(H), log_one_plus(j)
    return c[0] * excess + c[1] * excess * excess + c[2] / type(j)(2.0) * log_J * log_J


@wp.func
def stress(H: Any, c: Any):
    """P [Pa] = 2 w a M + K ln J F^-T; w = c1 + 2 c2 (I - 3), a = J^(-2/3), M = F - tr(F^T F) / 3 F^-T."""
    one, two, three = type(H[0, 0])(1.0), type(H[0, 0])(2.0), type(H[0, 0])(3.0)
    F, G, log_J = wp.identity(n=3, dtype=type(one)) + H, inverse_transpose(H), log_one_plus(volume_change(H))
    w, a = c[0] + two * c[1] * isochoric_excess(H), wp.exp(-two / three * log_J)
    return two * w * a * (F - wp.ddot(F, F) / three * G) + c[2] * log_J * G


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """dP [Pa] for dF = D, factor by factor."""
    one, two, three = type(H[0, 0])(1.0), type(H[0, 0])(2.0), type(H[0, 0])(3.0)
    F, G, log_J = wp.identity(n=3, dtype=type(one)) + H, inverse_transpose(H), log_one_plus(volume_change(H))
    w, a = c[0] + two * c[1] * isochoric_excess(H), wp.exp(-two / three * log_J)
    M = F - wp.ddot(F, F) / three * G
    t, dG = wp.ddot(G, D), -G * wp.transpose(D) * G
    dw, da = two * two * c[1] * a * wp.ddot(M, D), -two / three * a * t
    dM = D - two / three * wp.ddot(F, D) * G - wp.ddot(F, F) / three * dG
    return two * (dw * a + w * da) * M + two * w * a * dM + c[2] * (t * G + log_J * dG)


@dataclass(frozen=True)
class Yeoh:
    """A tissue of Yeoh's law: c1, c2 and the bulk modulus [Pa]."""

    # Without annotations these are no fields: they are the same of every tissue of the law.
    law = "yeoh"
    functions = Law("yeoh", energy, stress, stress_change, needs_positive_volume=True)
    prony = ()

    c1: float
    c2: float
    bulk: float

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa] at small strain: mu = 2 c1, lambda = K - 2 mu / 3."""
        mu = 2.0 * self.c1
        return mu, self.bulk - 2.0 * mu / 3.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """What the functions take."""
        return self.coefficients_at(*self.lame)

    def coefficients_at(self, mu: float, lam: float) -> tuple[float, ...]:
        """Return the law with other Lamé constants [Pa]; c2 scales with the shear modulus."""
        return mu / 2.0, self.c2 * mu / self.lame[0], lam + 2.0 * mu / 3.0


SOFT = Yeoh(c1=500.0, c2=1500.0, bulk=1e4)
"""About as soft as brain."""

if __name__ == "__main__":
    from sim.terms.laws.conformance import check_tissue

    for finding in check_tissue(SOFT):
        print(finding)

"""Interface of hyperelastic laws: three Warp functions of the displacement gradient."""

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Law:
    """Isotropic hyperelastic law in the displacement gradient H = F - I, with coefficients c (k,).

    energy(H, c) -> psi [Pa]; stress(H, c) -> P (3, 3) [Pa]; stress_change(H, D, c) -> dP (3, 3) [Pa] for dF = D.
    All are generic in the scalar type; c is Lamé's (mu, lambda) [Pa] unless the law defines others.
    `needs_positive_volume`: psi is infinite if det F <= 0, so steps are bounded. `at_rest`(c) -> c: coefficients
    that vary between points and load cases, reset to the undeformed state; None: none vary. `of_shape`(c) -> c: the
    law without bulk modulus, if the remainder depends on J only and is finite everywhere; None: not available.
    """

    name: str
    energy: wp.Function
    stress: wp.Function
    stress_change: wp.Function
    needs_positive_volume: bool = False
    at_rest: wp.Function | None = None
    of_shape: wp.Function | None = None

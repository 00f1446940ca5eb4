"""What a hyperelastic law is: three Warp functions of the displacement gradient."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Law:
    """An isotropic hyperelastic law in the displacement gradient H = F - I, with coefficients c (k,).

    energy(H, c) -> psi [Pa]; stress(H, c) -> P (3, 3) [Pa]; stress_change(H, D, c) -> dP (3, 3) [Pa] for dF = D.
    All are generic in the scalar type; c is Lamé's (mu, lambda) [Pa] unless the law says otherwise.
    `needs_positive_volume`: the law is infinite where det F <= 0, so steps are bounded. `at_rest`(c) -> c: of numbers
    that vary from point to point and from case to case, those of a body at rest; None: none do. `of_shape`(c) -> c: the
    law without its bulk modulus, where the rest is a law of J alone that is finite everywhere; None: it is not.
    """

    name: str
    energy: wp.Function
    stress: wp.Function
    stress_change: wp.Function
    needs_positive_volume: bool = False
    at_rest: wp.Function | None = None
    of_shape: wp.Function | None = None

"""Interface of hyperelastic laws: three Warp functions of the displacement gradient."""

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Law:
    """Isotropic hyperelastic law in the displacement gradient H = F - I, with coefficients c (k,).

    energy(H, c) -> psi [Pa]; stress(H, c) -> P (3, 3) [Pa]; stress_change(H, D, c) -> dP (3, 3) [Pa] for dF = D. All
    functions are generic in the scalar type; c is Lamé's (mu, lambda) [Pa] unless the law defines other coefficients.
    `needs_positive_volume`: True if psi is infinite for det F <= 0, so that steps are limited. `at_rest`(c) -> c in the
    undeformed state, for coefficients that vary; None if no coefficient varies. `of_shape`(c) -> c without bulk
    modulus, if the remaining energy depends only on J and is finite everywhere; None if not available.
    """

    name: str
    energy: wp.Function
    stress: wp.Function
    stress_change: wp.Function
    needs_positive_volume: bool = False
    at_rest: wp.Function | None = None
    of_shape: wp.Function | None = None

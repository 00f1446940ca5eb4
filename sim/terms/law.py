"""What a hyperelastic law is: three Warp functions of the displacement gradient."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Law:
    """An isotropic hyperelastic law in the displacement gradient H = F - I, with Lamé's mu and lambda [Pa].

    energy(H, mu, lam) -> psi [Pa]; stress(H, mu, lam) -> P (3, 3) [Pa];
    stress_change(H, D, mu, lam) -> dP (3, 3) [Pa] for dF = D. All are generic in the scalar type.
    `needs_positive_volume`: the law is infinite where det F <= 0, so steps are bounded.
    """

    name: str
    energy: wp.Function
    stress: wp.Function
    stress_change: wp.Function
    needs_positive_volume: bool = False

"""Hooke's law on the small strain tensor, for small rotations only.

psi = mu eps : eps + lambda/2 (tr eps)^2, eps = (H + H^T)/2
"""

from typing import Any

import warp as wp

from .law import Law


@wp.func
def stress(H: Any, c: Any):
    """Return the stress P [Pa] = mu (H + H^T) + lambda tr H I."""
    mu, lam = c[0], c[1]
    return mu * (H + wp.transpose(H)) + lam * wp.trace(H) * wp.identity(n=3, dtype=type(mu))


@wp.func
def energy(H: Any, c: Any):
    """Return the energy density psi [Pa] = P : H / 2."""
    return wp.ddot(stress(H, c), H) / type(c[0])(2.0)


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D."""
    return stress(D, c)


LAW = Law("linear", energy, stress, stress_change)

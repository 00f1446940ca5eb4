"""Compressible neo-Hookean law with logarithms, the form of FEBio and FElupe; infinite where J <= 0.

    psi = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2

Bonet, Wood 2008, "Nonlinear Continuum Mechanics for Finite Element Analysis", eq. 6.27.
"""

from typing import Any

import warp as wp

from .invariants import (
    cofactor_change,
    cofactor_excess,
    cofactor_matrix,
    log_one_plus,
    nonlinear_volume_change,
    volume_change,
)
from .law import Law


@wp.func
def log_volume_excess(j: Any):
    """Return j - ln(1 + j); for small j by the series of ln(1 + j) = 2 artanh s, s = j / (2 + j), which is accurate."""
    one = type(j)(1.0)
    if wp.abs(j) > type(j)(0.1):
        return j - wp.log(one + j)
    s = j / (type(j)(2.0) + j)
    q = s * s
    tail = one / type(j)(3.0) + q * (one / type(j)(5.0) + q * (one / type(j)(7.0) + q * (one / type(j)(9.0))))
    return s * (j - type(j)(2.0) * q * tail)


@wp.func
def energy(H: Any, c: Any):
    """Return psi [Pa] = mu (|H|^2 / 2 + tr H - ln J) + lambda/2 (ln J)^2; +inf where J <= 0."""
    mu, lam = c[0], c[1]
    half = type(mu)(0.5)
    j = volume_change(H)
    if j <= -type(mu)(1.0):
        return type(mu)(wp.inf)
    log_J = log_one_plus(j)
    return mu * (half * wp.ddot(H, H) - nonlinear_volume_change(H) + log_volume_excess(j)) + half * lam * log_J * log_J


@wp.func
def stress(H: Any, c: Any):
    """Return the first Piola-Kirchhoff stress P [Pa] = mu F + (lambda ln J - mu) F^-T, by powers of H."""
    mu, lam = c[0], c[1]
    identity = wp.identity(n=3, dtype=type(mu))
    j = volume_change(H)
    shrunk = mu / (type(mu)(1.0) + j)
    pressure = lam * log_one_plus(j) / (type(mu)(1.0) + j)
    normal = pressure - shrunk
    level = normal * wp.trace(H) + shrunk * j + pressure
    return mu * H + normal * (cofactor_matrix(H) - wp.transpose(H)) + level * identity


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D: mu D + (lambda ln J - mu) d(F^-T) + lambda (F^-T : D) F^-T."""
    mu, lam = c[0], c[1]
    identity = wp.identity(n=3, dtype=type(mu))
    j = volume_change(H)
    J = type(mu)(1.0) + j
    inverse = (identity + cofactor_excess(H)) / J  # F^-T
    trace = wp.ddot(inverse, D)
    inverse_change = cofactor_change(identity + H, D) / J - trace * inverse
    return mu * D + (lam * log_one_plus(j) - mu) * inverse_change + lam * trace * inverse


LAW = Law("neo-hookean", energy, stress, stress_change, needs_positive_volume=True)

"""Stable neo-Hookean law, finite for every deformation including inversion.

Smith, de Goes, Kim 2018, "Stable Neo-Hookean Flesh Simulation", ACM Trans. Graph. 37(2), without the logarithm and
with Lamé's constants re-mapped so that the law agrees with Hooke's at small strain:

    psi = mu/2 (I1 - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2
"""

from typing import Any

import warp as wp

from .invariants import cofactor_change, cofactor_excess, cofactor_matrix, nonlinear_volume_change, volume_change
from .law import Law


@wp.func
def energy(H: Any, c: Any):
    """Return psi [Pa] = mu (|H|^2 / 2 - (j - tr H)) + (lambda + mu)/2 j^2, with j = J - 1."""
    mu, lam = c[0], c[1]
    j = volume_change(H)
    half = type(mu)(0.5)
    return mu * (half * wp.ddot(H, H) - nonlinear_volume_change(H)) + half * (lam + mu) * j * j


@wp.func
def stress(H: Any, c: Any):
    """Return the first Piola-Kirchhoff stress P [Pa] = mu (F - cof F) + (lambda + mu) j cof F, by powers of H."""
    mu, lam = c[0], c[1]
    pressure = (lam + mu) * volume_change(H)
    normal = pressure - mu
    identity = wp.identity(n=3, dtype=type(mu))
    return mu * H + normal * (cofactor_matrix(H) - wp.transpose(H)) + (normal * wp.trace(H) + pressure) * identity


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D: mu (D - dcof) + (lambda + mu) ((cof F : D) cof F + j dcof)."""
    mu, lam = c[0], c[1]
    identity = wp.identity(n=3, dtype=type(mu))
    cof = identity + cofactor_excess(H)
    change = cofactor_change(identity + H, D)
    return mu * D + (lam + mu) * wp.ddot(cof, D) * cof + ((lam + mu) * volume_change(H) - mu) * change


@wp.func
def of_shape(c: Any):
    """Return Lamé constants with bulk modulus 0: the remainder of psi is K/2 (J - 1)^2, K = lambda + 2/3 mu."""
    k = c
    k[1] = -type(c[0])(2.0) / type(c[0])(3.0) * c[0]
    return k


LAW = Law("stable-neo-hookean", energy, stress, stress_change, of_shape=of_shape)

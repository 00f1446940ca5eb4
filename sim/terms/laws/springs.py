"""Mass-spring model: springs along the edges of tetrahedra, and a volume preserving energy.

Equal springs in all directions have Lamé parameters mu = lambda = sum k L^2 / (15 V), so Poisson's ratio is 1/4
(Cauchy's relation). The six springs of a tetrahedron thus have k = 15 mu V / sum L^2. For a regular tetrahedron this is
0.118 E L; Lloyd, Szekely, Harders 2007, IEEE Trans. Vis. Comput. Graph. 13:1081-1094, find 0.113 E L by comparison with
a finite element. The volume preserving energy of Teschner et al. 2004, "A versatile and robust model for geometrically
complex deformable solids", adds the missing stiffness lambda - mu:

    psi = sum of k (l - L)^2 / (2 V) + (lambda - mu)/2 (J - 1)^2
"""

from typing import Any

import numpy as np
import warp as wp

from ...errors import InputError
from .invariants import cofactor_change, cofactor_excess, volume_change
from .law import Law


@wp.func
def get_edge(c: Any, number: int):
    """Return the undeformed edge vector [m] with a number from 0 to 5: edges 01, 02, 03, 12, 13, 23."""
    return wp.vector(c[2 + 3 * number], c[3 + 3 * number], c[4 + 3 * number])


@wp.func
def compute_elongation(H: Any, L: Any):
    """Return l - L [m] of an undeformed edge L: (2 L.HL + |HL|^2) / (l + L), without cancellation."""
    h = H * L
    two = type(L[0])(2.0)
    return (two * wp.dot(L, h) + wp.dot(h, h)) / (wp.length(L + h) + wp.length(L))


@wp.func
def energy(H: Any, c: Any):
    """Return psi [Pa]."""
    j = volume_change(H)
    psi = c[1] * j * j
    for number in range(6):
        longer = compute_elongation(H, get_edge(c, number))
        psi += c[0] * longer * longer
    return psi / type(j)(2.0)


@wp.func
def stress(H: Any, c: Any):
    """Return P [Pa] = sum of k/V (l - L)/l FL (x) L + (lambda - mu) j cof F."""
    identity = wp.identity(n=3, dtype=type(c[0]))
    P = c[1] * volume_change(H) * (identity + cofactor_excess(H))
    for number in range(6):
        L = get_edge(c, number)
        moved = L + H * L
        P += c[0] * compute_elongation(H, L) / wp.length(moved) * wp.outer(moved, L)
    return P


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D, with d[(l - L)/l FL] = (l - L)/l DL + L (FL.DL) / l^3 FL."""
    identity = wp.identity(n=3, dtype=type(c[0]))
    cof = identity + cofactor_excess(H)
    dP = c[1] * (wp.ddot(cof, D) * cof + volume_change(H) * cofactor_change(identity + H, D))
    for number in range(6):
        L = get_edge(c, number)
        moved, way = L + H * L, D * L
        l = wp.length(moved)
        along = wp.length(L) * wp.dot(moved, way) / (l * l * l)
        dP += c[0] * wp.outer(compute_elongation(H, L) / l * way + along * moved, L)
    return dP


LAW = Law("springs", energy, stress, stress_change)


def compute_spring_coefficients(lame: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return k/V [Pa/m^2], lambda - mu [Pa] and six edges [m] (T, 20) of tetrahedra with mu, lambda (T, 2) [Pa].

    `gradient` (T, 1, 4, 3) [1/m] is that of the linear shape functions of each tetrahedron.

    Raises
    ------
    InputError
        Poisson's ratio is below 1/4, which springs cannot have.
    """
    mu, lam = lame.T
    if (lam < mu * (1.0 - 1e-9)).any():
        raise InputError("a mass-spring model has Poisson's ratio 0.25 or more: increase nu, or use finite elements.")
    edges = np.linalg.inv(gradient[:, 0, 1:]).transpose(0, 2, 1)
    edges = np.concatenate([edges, edges[:, [1, 2, 2]] - edges[:, [0, 0, 1]]], axis=1)
    return np.column_stack([15.0 * mu / (edges**2).sum(axis=(1, 2)), lam - mu, edges.reshape(-1, 18)])

"""Split of a law into a deviatoric part, which relaxes, and a volumetric part, for viscoelasticity."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ...runtime.device import Device
from .invariants import (
    cofactor_change,
    cofactor_excess,
    exp_less_one,
    green_strain,
    log_one_plus,
    scale_excess,
    volume_change,
)
from .law import Law


@wp.func
def compute_isochoric(H: Any):
    """Return the isochoric part Fb - I = J^(-1/3) (I + H) - I, accurate at small strain."""
    k = exp_less_one(-log_one_plus(volume_change(H)) / type(H[0, 0])(3.0))
    return scale_excess(H, k)


@wp.func
def compute_volumetric(H: Any):
    """Return the volumetric part J^(1/3) I - I."""
    k = exp_less_one(log_one_plus(volume_change(H)) / type(H[0, 0])(3.0))
    return k * wp.identity(n=3, dtype=type(k))


@wp.func
def compute_inverse_transpose(H: Any):
    """Return the inverse transpose (I + H)^-T."""
    J = type(H[0, 0])(1.0) + volume_change(H)
    return (wp.identity(n=3, dtype=type(J)) + cofactor_excess(H)) / J


@dataclass(frozen=True)
class LawSplit:
    """Warp functions of a split law with coefficients k, for a displacement gradient H with an increment D.

    energy(H, k, beta, A) -> psi + beta psi_shape + A : E [Pa]; E is the strain conjugate to a stress A [Pa]. stress and
    stress_change(H, D, ...) are its derivatives. overstress(H, k) -> S [Pa] is the deviatoric stress conjugate to E.
    """

    energy: wp.Function
    stress: wp.Function
    stress_change: wp.Function
    overstress: wp.Function
    needs_positive_volume: bool


def build_law_split(law: Law, device: Device) -> LawSplit:
    """Return the split that the law defines, or else the split by the isochoric part of F."""
    return build_isochoric_split(law, device) if law.of_shape is None else build_user_split(law, law.of_shape, device)


@cache
def build_isochoric_split(law: Law, device: Device) -> LawSplit:
    """Return the split with deviatoric part psi(F) - psi(J^(1/3) I), E = (Fb^T Fb - I) / 2 and Fb = J^(-1/3) F."""
    scalar, mat = device.scalar, device.matrix
    own_energy, own_stress, own_change = law.energy, law.stress, law.stress_change

    @wp.func
    def energy(H: mat, k: Any, beta: scalar, A: mat):
        """Return psi(F) + beta (psi(F) - psi(J^(1/3) I)) + (Cb - I) : A / 2; +inf where J <= 0."""
        if volume_change(H) <= scalar(-1.0):
            return scalar(wp.inf)
        own = own_energy(H, k)
        E = green_strain(compute_isochoric(H))
        return own + beta * (own - own_energy(compute_volumetric(H), k)) + wp.ddot(E, A)

    @wp.func
    def stress(H: mat, k: Any, beta: scalar, A: mat):
        """Return (1+beta) P(F) - beta p J^(1/3) F^-T + J^(-1/3) (Q - (Q:F) F^-T / 3), p I = P(J^(1/3) I), Q = Fb A."""
        F, Q = wp.identity(n=3, dtype=scalar) + H, A + compute_isochoric(H) * A
        G, V = compute_inverse_transpose(H), compute_volumetric(H)
        wide = scalar(1.0) + V[0, 0]
        p = own_stress(V, k)[0, 0]
        level = beta * p * wide + wp.ddot(Q, F) / (scalar(3.0) * wide)
        return (scalar(1.0) + beta) * own_stress(H, k) + Q / wide - level * G

    @wp.func
    def stress_change(H: mat, D: mat, k: Any, beta: scalar, A: mat):
        """Return dP [Pa] for dF = D, the derivative of `stress`, by the product rule."""
        three = scalar(3.0)
        identity = wp.identity(n=3, dtype=scalar)
        F, V, G = identity + H, compute_volumetric(H), compute_inverse_transpose(H)
        J, wide = scalar(1.0) + volume_change(H), scalar(1.0) + V[0, 0]
        swelling = wp.ddot(G, D)
        widening = wide * swelling / three
        dG = cofactor_change(F, D) / J - swelling * G
        Q = A + compute_isochoric(H) * A
        dQ = (D - swelling / three * F) * A / wide
        p, dp = own_stress(V, k)[0, 0], own_change(V, widening * identity, k)[0, 0]
        level = beta * p * wide + wp.ddot(Q, F) / (three * wide)
        pulled = (wp.ddot(dQ, F) + wp.ddot(Q, D) - swelling / three * wp.ddot(Q, F)) / (three * wide)
        rise = beta * (dp * wide + p * widening) + pulled
        own = (scalar(1.0) + beta) * own_change(H, D, k)
        return own + (dQ - swelling / three * Q) / wide - rise * G - level * dG

    @wp.func
    def overstress(H: mat, k: Any):
        """Return S = Fb^-1 dev(P F^T) Fb^-T = J^(1/3) Fb^-1 (P - (P : Fb) Fb^-T / 3)."""
        Hb, P = compute_isochoric(H), own_stress(H, k)
        identity = wp.identity(n=3, dtype=scalar)
        G, wide = identity + cofactor_excess(Hb), scalar(1.0) + compute_volumetric(H)[0, 0]
        return wide * (wp.transpose(G) * (P - wp.ddot(P, identity + Hb) / scalar(3.0) * G))

    return LawSplit(energy, stress, stress_change, overstress, True)


@cache
def build_user_split(law: Law, of_shape: wp.Function, device: Device) -> LawSplit:
    """Return the split whose deviatoric part is the law with coefficients `of_shape`, with E = (F^T F - I) / 2.

    The potential is finite if that of the law is finite; the overstress is infinite at J = 0. Fully relaxed tissue
    has the same law with a smaller shear modulus and the same bulk modulus.
    """
    scalar, mat = device.scalar, device.matrix
    own_energy, own_stress, own_change = law.energy, law.stress, law.stress_change

    @wp.func
    def energy(H: mat, k: Any, beta: scalar, A: mat):
        """Return psi + beta psi_shape + (C - I) : A / 2."""
        return own_energy(H, k) + beta * own_energy(H, of_shape(k)) + wp.ddot(green_strain(H), A)

    @wp.func
    def stress(H: mat, k: Any, beta: scalar, A: mat):
        """Return the stress P + beta P_shape + F A."""
        return own_stress(H, k) + beta * own_stress(H, of_shape(k)) + A + H * A

    @wp.func
    def stress_change(H: mat, D: mat, k: Any, beta: scalar, A: mat):
        """Return the stress increment dP + beta dP_shape + D A."""
        return own_change(H, D, k) + beta * own_change(H, D, of_shape(k)) + D * A

    @wp.func
    def overstress(H: mat, k: Any):
        """Return the overstress S = F^-1 P_shape."""
        return wp.transpose(compute_inverse_transpose(H)) * own_stress(H, of_shape(k))

    return LawSplit(energy, stress, stress_change, overstress, False)

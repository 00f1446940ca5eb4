"""Corotational law: Hooke's law in coordinates that rotate with R, the rotation nearest to F.

    psi = mu |F - R|^2 + lambda/2 tr(R^T F - I)^2, F = R S

Sifakis, Barbic 2012, "FEM Simulation of 3D Deformable Solids", SIGGRAPH course, section 3.4. For inverted elements, R
is also a rotation, and the smallest singular value is negative.
"""

from typing import Any

import warp as wp

from .law import Law


@wp.func
def compute_axial_vector(A: Any):
    """Return the vector w with [w]x = A - A^T."""
    return wp.vector(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])


@wp.func
def compute_rotation_rate(S: Any, A: Any):
    """Return w with (tr S I - S) w = axial A: the rotation R exp([w]x) that follows a change R A of F = R S.

    w is zero if the stretch S determines no rotation, because the sum of two principal stretches is zero.
    """
    tiny = type(S[0, 0])(1.0e-6)
    G = wp.trace(S) * wp.identity(n=3, dtype=type(tiny)) - S
    size = wp.ddot(G, G)
    if wp.abs(wp.determinant(G)) <= tiny * size * wp.sqrt(size):
        return compute_axial_vector(A) * type(tiny)(0.0)
    return wp.inverse(G) * compute_axial_vector(A)


@wp.func
def build_cross_matrix(w: Any):
    """Return the cross product matrix [w]x."""
    zero = type(w[0])(0.0)
    return wp.matrix_from_rows(wp.vector(zero, -w[2], w[1]), wp.vector(w[2], zero, -w[0]), wp.vector(-w[1], w[0], zero))


@wp.func
def compute_rotation_excess(H: Any):
    """Return Q = R - I for the rotation R nearest to F = I + H, by Warp's approximate SVD and Newton steps.

    For a unit quaternion (v, w), Q = 2 w [v]x + 2 [v]x^2 without cancellation for R near I.
    """
    one = type(H[0, 0])(1.0)
    two = type(one)(2.0)
    U, s, V = wp.svd3(wp.identity(n=3, dtype=type(one)) + H)
    R = U * wp.transpose(V)
    if wp.determinant(R) < type(one)(0.0):
        least = int(2)
        if s[0] < s[1] and s[0] < s[2]:
            least = int(0)
        elif s[1] < s[2]:
            least = int(1)
        for i in range(3):
            U[i, least] = -U[i, least]
        R = U * wp.transpose(V)
    turn = wp.normalize(wp.quat_from_matrix(R))
    Q = compute_quaternion_excess(turn)
    for _ in range(2):
        B = compute_rotated_strain(H, Q)
        half = compute_rotation_rate(wp.identity(n=3, dtype=type(one)) + (B + wp.transpose(B)) / two, B) / two
        # Cayley's transform of [2 half]x is the quaternion (half, 1): it agrees with exp to second order.
        turn = wp.normalize(turn * wp.quaternion(half, one))
        Q = compute_quaternion_excess(turn)
    return Q


@wp.func
def compute_quaternion_excess(turn: Any):
    """Return R - I of a unit quaternion."""
    X = build_cross_matrix(wp.vector(turn[0], turn[1], turn[2]))
    return type(turn[0])(2.0) * (turn[3] * X + X * X)


@wp.func
def compute_rotated_strain(H: Any, Q: Any):
    """Return R^T F - I from H = F - I and Q = R - I."""
    return H + wp.transpose(Q) + wp.transpose(Q) * H


@wp.func
def energy(H: Any, c: Any):
    """Return the energy density psi [Pa] = mu |S - I|^2 + lambda/2 tr(S - I)^2."""
    mu, lam = c[0], c[1]
    strain = compute_rotated_strain(H, compute_rotation_excess(H))
    t = wp.trace(strain)
    return mu * wp.ddot(strain, strain) + type(mu)(0.5) * lam * t * t


@wp.func
def stress(H: Any, c: Any):
    """Return the stress P [Pa] = 2 mu (F - R) + lambda tr(S - I) R."""
    mu, lam = c[0], c[1]
    Q = compute_rotation_excess(H)
    t = wp.trace(compute_rotated_strain(H, Q))
    return type(mu)(2.0) * mu * (H - Q) + lam * t * (wp.identity(n=3, dtype=type(mu)) + Q)


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D: 2 mu D + lambda tr(R^T D) R + (lambda tr(S - I) - 2 mu) dR.

    dR = R [w]x with (tr S I - S) w = axial(R^T D): Barbic 2012, "Exact corotational linear FEM stiffness matrix".
    """
    mu, lam = c[0], c[1]
    two = type(mu)(2.0)
    identity = wp.identity(n=3, dtype=type(mu))
    Q = compute_rotation_excess(H)
    R = identity + Q
    strain = compute_rotated_strain(H, Q)
    A = wp.transpose(R) * D
    w = compute_rotation_rate(identity + strain, A)
    t = wp.trace(strain)
    return two * mu * D + lam * wp.trace(A) * R + (lam * t - two * mu) * (R * build_cross_matrix(w))


LAW = Law("corotational", energy, stress, stress_change)

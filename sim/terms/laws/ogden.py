"""Ogden's law on isochoric stretches; infinite where J <= 0.

    psi = sum_i c_i / m_i^2 (l1^m_i + l2^m_i + l3^m_i - 3) + K/2 (ln J)^2,  l_k = J^(-1/3) lambda_k

Ogden 1972, Proc. R. Soc. Lond. A 326:565-584, in the uncoupled form of FEBio's theory manual. The functions use the
eigenvalues e_k of Green's strain, lambda_k^2 = 1 + 2 e_k, and the logarithms y_k = ln l_k, whose sum is zero. There is
no cancellation at small strain and no special case for equal stretches. Coefficients: (K, L, c_1, m_1, c_2, m_2, ...).
Where a term m_i y_k exceeds |m_i| L, for a limit L, its exponential continues as a Taylor polynomial of second degree.
"""

from typing import Any

import warp as wp

from .invariants import exp_less_one, green_strain, log_one_plus, volume_change
from .law import Law
from .ogden_powers import change_power_stress, compute_power_stress, is_power_sum
from .spectral import compute_principal_axes


@wp.func
def compute_log_stretches(H: Any, e: Any, N: Any):
    """Return ln lambda_k = log1p(2 e_k) / 2, or ln |F n_k| under strong compression, where 1 + 2 e_k loses digits."""
    one, two = type(e[0])(1.0), type(e[0])(2.0)
    x = type(e)()
    for k in range(3):
        square = one + two * e[k]
        if square > one / two:
            x[k] = log_one_plus(two * e[k]) / two
        else:
            f = N[k] + H * N[k]
            x[k] = wp.log(wp.dot(f, f)) / two
    return x


@wp.func
def compute_squared_stretches(x: Any):
    """Return the squared stretches lambda_k^2 = exp(2 x_k)."""
    two = type(x[0])(2.0)
    return wp.vector(wp.exp(two * x[0]), wp.exp(two * x[1]), wp.exp(two * x[2]))


@wp.func
def compute_isochoric_log_stretches(x: Any):
    """Return the isochoric part y_k = ln l_k = x_k - mean x."""
    mean = (x[0] + x[1] + x[2]) / type(x[0])(3.0)
    return x - wp.vector(mean, mean, mean)


@wp.func
def exp_excess(t: Any):
    """Return exp(t) - 1 - t, for small t by a series to avoid cancellation."""
    one = type(t)(1.0)
    if wp.abs(t) > one:
        return wp.exp(t) - one - t
    tail = one
    for i in range(16):
        tail = one + t / type(t)(18 - i) * tail
    return t * t / type(t)(2.0) * tail


@wp.func
def sinh_ratio(z: Any):
    """Return sinh(z) / z."""
    if z == type(z)(0.0):
        return type(z)(1.0)
    return wp.sinh(z) / z


@wp.func
def compute_kirchhoff_stresses(H: Any, y: Any, c: Any):
    """Return principal Kirchhoff stresses t_k [Pa] = a_k - mean a + K ln J, with a_k = sum_i c_i / m_i l_k^m_i."""
    one, two = type(c[0])(1.0), type(c[0])(2.0)
    a = type(y)()
    for i in range(len(c) // 2 - 1):
        m = c[2 * i + 3]
        for k in range(3):
            t = wp.min(m * y[k], wp.abs(m) * c[1])
            over, growth = m * y[k] - t, exp_less_one(t)
            a[k] += c[2 * i + 2] / m * (growth + (growth + one) * (over + over * over / two))
    level = c[0] * log_one_plus(volume_change(H)) - (a[0] + a[1] + a[2]) / type(c[0])(3.0)
    return a + wp.vector(level, level, level)


@wp.func
def energy(H: Any, c: Any):
    """Return psi [Pa] = sum_i c_i / m_i^2 sum_k (exp(m_i y_k) - 1 - m_i y_k) + K/2 (ln J)^2; +inf where J <= 0.

    Beyond the limit the polynomial of `compute_kirchhoff_stresses` is integrated.
    """
    j = volume_change(H)
    one, two = type(j)(1.0), type(j)(2.0)
    if j <= -one:
        return type(j)(wp.inf)
    log_J = log_one_plus(j)
    e, N = compute_principal_axes(green_strain(H))
    x = compute_log_stretches(H, e, N)
    y = compute_isochoric_log_stretches(x)
    psi = c[0] / two * log_J * log_J
    for i in range(len(c) // 2 - 1):
        m = c[2 * i + 3]
        for k in range(3):
            t = wp.min(m * y[k], wp.abs(m) * c[1])
            over, growth = m * y[k] - t, exp_less_one(t)
            higher = (growth + one) * over * over * (one / two + over / (two + two + two))
            psi += c[2 * i + 2] / (m * m) * (exp_excess(t) + growth * over + higher)
    return psi


@wp.func
def stress(H: Any, c: Any):
    """Return the stress P [Pa] = F S, with S = sum_k t_k / lambda_k^2 n_k (x) n_k."""
    if is_power_sum(H, c):
        return compute_power_stress(H, c)
    e, N = compute_principal_axes(green_strain(H))
    x = compute_log_stretches(H, e, N)
    t = compute_kirchhoff_stresses(H, compute_isochoric_log_stretches(x), c)
    S = wp.transpose(N) * wp.diag(wp.cw_div(t, compute_squared_stretches(x))) * N
    return S + H * S


@wp.func
def compute_divided_difference(k: int, l: int, e: Any, y: Any, c: Any):
    """Return b_kl [Pa] = sum_i c_i exp(m_i (y_k + y_l) / 2) sinh(m_i d / 2) / (m_i d / 2) x d / tanh d.

    b_kl is the divided difference of a in `compute_kirchhoff_stresses` over the eigenvalues e, times the mean squared
    stretch. With tanh d = (e_k - e_l) / (1 + e_k + e_l), d = ln(lambda_k / lambda_l), equal stretches are accurate too.
    Of the interval between y_k and y_l, the part within the limit has this mean slope, the other that of its middle.
    """
    one, two = type(c[0])(1.0), type(c[0])(2.0)
    tanh = wp.abs(e[k] - e[l]) / (one + e[k] + e[l])
    d = wp.abs(y[k] - y[l])
    if tanh < one / two:
        d = log_one_plus(two * tanh / (one - tanh)) / two
    total = type(one)(0.0)
    for i in range(len(c) // 2 - 1):
        m = c[2 * i + 3]
        p, q = wp.min(m * y[k], wp.abs(m) * c[1]), wp.min(m * y[l], wp.abs(m) * c[1])
        start, end = m * y[k] - p, m * y[l] - q
        slope = wp.exp(p) * (one + (start + end) / two)
        if p != q:
            slope = (p - q) * wp.exp((p + q) / two) * sinh_ratio((p - q) / two)
            slope += start * wp.exp(p) * (one + start / two) - end * wp.exp(q) * (one + end / two)
            slope = slope / (m * y[k] - m * y[l])
        total += c[2 * i + 2] * slope
    if tanh > type(one)(0.0):
        total = total * d / tanh
    return total


@wp.func
def stress_change(H: Any, D: Any, c: Any):
    """Return dP [Pa] for dF = D: D S + F dS, dS in principal axes from the strain increment G = sym(F^T D) there.

    lambda_k^2 lambda_l^2 dS_kl = (b_kl - t_k - t_l) G_kl, and each lambda_k^2 dS_kk has in addition the sum over l of
    (K + tr b / 9 - (b_kk + b_ll) / 3) G_ll / lambda_l^2.
    """
    if is_power_sum(H, c):
        return change_power_stress(H, D, c)
    one, two, three = type(c[0])(1.0), type(c[0])(2.0), type(c[0])(3.0)
    e, N = compute_principal_axes(green_strain(H))
    x = compute_log_stretches(H, e, N)
    y = compute_isochoric_log_stretches(x)
    t = compute_kirchhoff_stresses(H, y, c)
    q = wp.cw_div(wp.vector(one, one, one), compute_squared_stretches(x))
    G = D + wp.transpose(H) * D
    G = N * (G + wp.transpose(G)) * wp.transpose(N) / two
    dS = type(H)()
    b = type(e)()
    for k in range(3):
        b[k] = compute_divided_difference(k, k, e, y, c)
        for l in range(k):
            dS[k, l] = q[k] * q[l] * (compute_divided_difference(k, l, e, y, c) - t[k] - t[l]) * G[k, l]
            dS[l, k] = dS[k, l]
    g = wp.cw_mul(q, wp.get_diag(G))
    swelling = g[0] + g[1] + g[2]
    level = (c[0] + (b[0] + b[1] + b[2]) / (three * three)) * swelling - wp.dot(b, g) / three
    for k in range(3):
        dS[k, k] = q[k] * ((b[k] - two * t[k]) * g[k] + level - b[k] * swelling / three)
    S = wp.diag(wp.cw_mul(q, t))
    S, dS = wp.transpose(N) * S * N, wp.transpose(N) * dS * N
    return D * S + dS + H * dS


LAW = Law("ogden", energy, stress, stress_change, needs_positive_volume=True)

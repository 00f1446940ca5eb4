"""Contact barrier between two surfaces, with a pressure that increases as the gap closes.

    b(d) = -k (d - g)^2 ln(d / g) for 0 < d < g, 0 beyond: Li et al. 2020, "Incremental Potential Contact", eq. 6.

Below g / 100, b continues as the parabola with the same value, slope and curvature (relaxed barrier: Feller, Ebenbauer
2017, IEEE Trans. Autom. Control 62:1223-1238), so penetrating tools push tissue out and any initial state is feasible.
With k = mu / g and the shear modulus mu of the tissue, the pressure at g / 100 is 107 mu: lower pressures leave a gap.
"""

from typing import Any

import warp as wp

# Fraction of the gap below which the barrier is a parabola.
PARABOLA_FRACTION = wp.constant(0.01)


@wp.func
def barrier(d: Any, g: Any):
    """Return the barrier function b(d) / k [m^2] at distance d with gap g."""
    zero = type(d)(0.0)
    if d >= g:
        return zero
    low = type(d)(PARABOLA_FRACTION) * g
    e = wp.max(d, low)
    value = -(e - g) * (e - g) * wp.log(e / g)
    if d < low:
        value += (d - low) * (barrier_slope(low, g) + type(d)(0.5) * (d - low) * barrier_curvature(low, g))
    return value


@wp.func
def barrier_slope(d: Any, g: Any):
    """Return the first derivative b'(d) / k [m], which is never positive, since contact is purely repulsive."""
    if d >= g:
        return type(d)(0.0)
    low = type(d)(PARABOLA_FRACTION) * g
    e = wp.max(d, low)
    slope = -(type(d)(2.0) * (e - g) * wp.log(e / g) + (e - g) * (e - g) / e)
    if d < low:
        slope += (d - low) * barrier_curvature(low, g)
    return slope


@wp.func
def barrier_curvature(d: Any, g: Any):
    """Return the second derivative b''(d) / k, which is never negative."""
    if d >= g:
        return type(d)(0.0)
    e = wp.max(d, type(d)(PARABOLA_FRACTION) * g)
    return -(type(d)(2.0) * wp.log(e / g) + type(d)(4.0) * (e - g) / e - (e - g) * (e - g) / (e * e))

"""Kernels of L-BFGS for many load cases; the next action of each load case is determined on the device.

A curvature pair (s, y) of a step and the change of the gradient along the step is stored as s and w = M^-1 y, where
M^-1 is the preconditioner. The two-loop recursion, Nocedal, Wright 2006, "Numerical Optimization", algorithm 7.4, then
needs only inner products with s and w, and the direction is a linear combination of s and w.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.columns import CHUNK
from ..runtime.device import Device, forward_kernel

LIVE, DONE, STOPPED, NOT_FINITE = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
"""Status of a load case: iterating; converged; stopped without convergence; values at the start not finite."""
PAIRS = 8  # Curvature pairs (s, y) that each load case keeps.
OVERSHOOT = 0.5  # A step is accepted if phi'(t) <= OVERSHOOT |phi'(0)|, with phi the energy along the direction.
MIN_BACKTRACK = 0.1  # Backtracking factor: lower bound.
DEFAULT_BACKTRACK = 0.25  # Backtracking factor where the trial is not finite.
MAX_BACKTRACK = 0.7  # Backtracking factor: upper bound.
MAX_BACKTRACKS = 12  # Maximum number of backtracking steps in a row.
ROWS_PER_THREAD = 16  # Rows, or nodes, per thread, so that the data of their load case are read once.
# Smallest change of the slope along a step, relative to |phi'(0)|, for a pair of positive curvature to be stored.
MIN_CURVATURE = 1e-3
# Rows of `sums`: |g - constant|^2, |g|^2, |residual|^2, residual . d, with g the gradient.
OWN, WHOLE, FREE, SLOPE = 0, 1, 2, 3
SUMS = 4  # Number of rows of `sums`.
# Rows of `products` after the 2 m with the pairs: g' . z', g' . z, y . w.
GZ, GZ_OLD, YW = 0, 1, 2
PRODUCTS = 3  # Number of these rows.


@dataclass(frozen=True)
class LbfgsKernels:
    """L-BFGS kernels for one scalar type and one number of curvature pairs."""

    add_gradient: wp.Kernel
    compute_products: wp.Kernel
    check_step: wp.Kernel
    set_direction: wp.Kernel
    accept_step: wp.Kernel
    limit_step: wp.Kernel


def get_rows_per_thread(device: Device) -> int:
    """Return the number of rows per thread, for kernels that need several values per row."""
    return 1 if device.on_cuda else 4


@cache
def build_kernels(device: Device, max_pairs: int) -> LbfgsKernels:
    """Return the kernels for the scalar type of a device, and `max_pairs` curvature pairs per load case."""
    scalar = device.scalar
    several, few_scalars = (
        wp.types.vector(length=length, dtype=scalar) for length in (ROWS_PER_THREAD, get_rows_per_thread(device))
    )
    weights = wp.types.vector(length=max_pairs, dtype=wp.float64)
    products_of_pairs = wp.types.matrix(shape=(max_pairs, max_pairs), dtype=wp.float64)
    m, chunk, some, few = max_pairs, CHUNK, ROWS_PER_THREAD, get_rows_per_thread(device)
    overshoot, least_kept, kept, most_kept = OVERSHOOT, MIN_BACKTRACK, DEFAULT_BACKTRACK, MAX_BACKTRACK
    cuts, least_curvature = MAX_BACKTRACKS, MIN_CURVATURE
    whole_row, free_row, slope_row = WHOLE, FREE, SLOPE
    gz_row, gold_row, yw_row = 2 * m + GZ, 2 * m + GZ_OLD, 2 * m + YW

    @forward_kernel(module="unique")
    def add_gradient(
        # outputs
        term_gradient: wp.array2d(dtype=scalar),
        gradient: wp.array2d(dtype=scalar),
        square: wp.array(dtype=wp.float64),
    ):
        """Add a term's gradient to the sum, and its squared norm to `square`; then clear the gradient of the term."""
        block, c = wp.tid()
        squares = wp.float64(0.0)
        for r in range(block * chunk, wp.min((block + 1) * chunk, term_gradient.shape[0])):
            x = term_gradient[r, c]
            gradient[r, c] += x
            term_gradient[r, c] = scalar(0.0)
            squares += wp.float64(x) * wp.float64(x)
        wp.atomic_add(square, c, squares)

    @forward_kernel(module="unique")
    def compute_products(
        pair_count: wp.array(dtype=wp.int32),
        s: wp.array3d(dtype=scalar),
        w: wp.array3d(dtype=scalar),
        g: wp.array2d(dtype=scalar),
        z: wp.array2d(dtype=scalar),
        new_g: wp.array2d(dtype=scalar),
        new_z: wp.array2d(dtype=scalar),
        # outputs
        products: wp.array2d(dtype=wp.float64),
    ):
        """Compute inner products: new gradient g' with each s and w, and with z' and z, where z = M^-1 g; and y . w."""
        block, c = wp.tid()
        last = g.shape[0] - 1
        own = several()
        gz, gold, yw = scalar(0.0), scalar(0.0), scalar(0.0)
        for k in range(some):
            r = wp.min(some * block + k, last)
            inside = wp.where(some * block + k <= last, scalar(1.0), scalar(0.0))
            own[k] = inside * new_g[r, c]
            gz += own[k] * new_z[r, c]
            gold += own[k] * z[r, c]
            yw += (own[k] - inside * g[r, c]) * (new_z[r, c] - z[r, c])
        wp.atomic_add(products, gz_row, c, wp.float64(gz))
        wp.atomic_add(products, gold_row, c, wp.float64(gold))
        wp.atomic_add(products, yw_row, c, wp.float64(yw))
        for i in range(pair_count[c]):
            sg, wg = scalar(0.0), scalar(0.0)
            for k in range(some):
                r = wp.min(some * block + k, last)
                sg += own[k] * s[i, r, c]
                wg += own[k] * w[i, r, c]
            wp.atomic_add(products, i, c, wp.float64(sg))
            wp.atomic_add(products, m + i, c, wp.float64(wg))

    @forward_kernel(module="unique")
    def check_step(
        constant_norms: wp.array2d(dtype=wp.float64),
        term_norms: wp.array2d(dtype=wp.float64),
        tolerance: wp.array(dtype=wp.float64),
        force_tolerance: wp.array(dtype=wp.float64),
        sums: wp.array2d(dtype=wp.float64),
        predicted: wp.array(dtype=wp.float64),
        # outputs
        status: wp.array(dtype=wp.int32),
        accepted: wp.array(dtype=wp.int32),
        steps: wp.array(dtype=wp.int32),
        backtracks: wp.array(dtype=wp.int32),
        t: wp.array(dtype=wp.float64),
        step_length: wp.array(dtype=wp.float64),
        residual: wp.array(dtype=wp.float64),
        slot: wp.array(dtype=wp.int32),
        needs_direction: wp.array(dtype=wp.int32),
    ):
        """Accept the trial step, or backtrack; the first trial is the start. Set `needs_direction` on acceptance."""
        c = wp.tid()
        accepted[c] = 0
        slot[c] = -1
        needs_direction[c] = 0
        if status[c] != LIVE:
            return
        zero = wp.float64(0.0)
        slope, free, whole = sums[slope_row, c], sums[free_row, c], sums[whole_row, c]
        scale = wp.max(whole - free, zero)  # the projection is orthogonal
        for k in range(term_norms.shape[0]):
            scale = wp.max(scale, term_norms[k, c])
        for k in range(constant_norms.shape[0]):
            scale = wp.max(scale, constant_norms[k, c])
        finite = wp.isfinite(free) and wp.isfinite(slope) and wp.isfinite(scale)
        relative = wp.sqrt(free)
        small = relative <= force_tolerance[c]
        if scale > zero:
            relative = relative / wp.sqrt(scale)
        first = predicted[c] == wp.float64(wp.inf)
        done = finite and (small or relative <= tolerance[c])
        if done or (finite and slope <= wp.float64(overshoot) * predicted[c]):
            accepted[c] = 1
            step_length[c] = t[c]
            residual[c] = relative
            backtracks[c] = 0
            if not first:
                steps[c] = steps[c] + 1
        elif first:
            status[c] = NOT_FINITE
        else:
            share = wp.float64(kept)
            if finite:
                share = wp.clamp(predicted[c] / (predicted[c] + slope), wp.float64(least_kept), wp.float64(most_kept))
            t[c] = share * t[c]
            backtracks[c] = backtracks[c] + 1
            if backtracks[c] > cuts:
                status[c] = STOPPED
        if done:
            status[c] = DONE
        if status[c] != LIVE:
            t[c] = zero
        elif accepted[c] != 0:
            needs_direction[c] = 1

    @forward_kernel(module="unique")
    def set_direction(
        needs_direction: wp.array(dtype=wp.int32),
        step_length: wp.array(dtype=wp.float64),
        sums: wp.array2d(dtype=wp.float64),
        products: wp.array2d(dtype=wp.float64),
        # outputs
        status: wp.array(dtype=wp.int32),
        newest: wp.array(dtype=wp.int32),
        pair_count: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        t: wp.array(dtype=wp.float64),
        predicted: wp.array(dtype=wp.float64),
        sg: wp.array2d(dtype=wp.float64),
        wg: wp.array2d(dtype=wp.float64),
        sy: wp.array3d(dtype=wp.float64),
        yw: wp.array3d(dtype=wp.float64),
        weights_s: wp.array2d(dtype=scalar),
        weights_w: wp.array2d(dtype=scalar),
    ):
        """Add the pair of the accepted step; two-loop recursion for d = -M^-1 g + sum of (a_i s_i + b_i w_i).

        The first `pair_count` slots are filled; slot 0 follows slot m - 1. The first trial length is the secant step of
        the previous line search, since every unit step would be shortened where tissue stiffens.
        """
        c = wp.tid()
        if needs_direction[c] == 0:
            return
        zero = wp.float64(0.0)
        slope, gz = sums[slope_row, c], products[gz_row, c]
        rise = slope + predicted[c]
        length = wp.float64(1.0)
        if rise > zero and wp.isfinite(predicted[c]):
            length = wp.clamp(step_length[c] * predicted[c] / rise, wp.float64(least_kept), wp.float64(1.0))
        n = int(-1)
        # Also false at the start, where `predicted` is infinite.
        if rise > wp.float64(least_curvature) * predicted[c] and products[yw_row, c] > zero:
            n = (newest[c] + 1) % m
            for i in range(m):
                change = products[m + i, c] - wg[i, c]
                sy[i, n, c] = products[i, c] - sg[i, c]
                yw[i, n, c] = change
                yw[n, i, c] = change
            sy[n, n, c] = step_length[c] * rise
            yw[n, n, c] = products[yw_row, c]
            newest[c] = n
            pair_count[c] = wp.min(pair_count[c] + 1, m)
            slot[c] = n
        size = pair_count[c]
        for i in range(m):
            sg[i, c] = wp.where(i == n, step_length[c] * slope, products[i, c])
            wg[i, c] = wp.where(i == n, gz - products[gold_row, c], products[m + i, c])
        # Sorted by age, in registers: the recursion is sequential.
        by_s, by_w, along, across = weights(), weights(), weights(), weights()
        curved, crossed = products_of_pairs(), products_of_pairs()
        for a in range(m):
            i = (newest[c] - a + m) % m
            along[a] = sg[i, c]
            across[a] = wg[i, c]
            for b in range(m):
                if b <= a:
                    j = (newest[c] - b + m) % m
                    curved[a, b] = sy[i, j, c]
                    crossed[a, b] = yw[i, j, c]
        for a in range(m):  # first loop, newest pair to oldest
            if a < size:
                value = along[a]
                for b in range(m):
                    if b < a:
                        value -= by_w[b] * curved[a, b]
                by_w[a] = value / curved[a, a]
        for k in range(m):  # second loop, oldest pair to newest
            a = m - 1 - k
            if a < size:
                value = across[a]
                for b in range(m):
                    if b < size:
                        if b > a:
                            value -= by_w[b] * crossed[b, a] + by_s[b] * curved[b, a]
                        else:
                            value -= by_w[b] * crossed[a, b]
                by_s[a] = value / curved[a, a] - by_w[a]
        decrease = gz
        for a in range(m):
            if a < size:
                decrease -= by_w[a] * across[a] + by_s[a] * along[a]
        if not decrease > zero:  # no descent direction, by round-off: restart from -M^-1 g
            decrease = gz
            pair_count[c] = 0
            newest[c] = m - 1
        for a in range(m):
            i = (newest[c] - a + m) % m
            weights_s[i, c] = scalar(by_s[a])
            weights_w[i, c] = scalar(by_w[a])
        predicted[c] = decrease
        t[c] = length
        if not (decrease > zero and wp.isfinite(decrease)):
            status[c] = STOPPED
            t[c] = zero

    @forward_kernel(module="unique")
    def accept_step(
        status: wp.array(dtype=wp.int32),
        accepted: wp.array(dtype=wp.int32),
        pair_count: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        step_length: wp.array(dtype=wp.float64),
        weights_s: wp.array2d(dtype=scalar),
        weights_w: wp.array2d(dtype=scalar),
        new_g: wp.array2d(dtype=scalar),
        new_z: wp.array2d(dtype=scalar),
        # outputs
        u: wp.array2d(dtype=scalar),
        d: wp.array2d(dtype=scalar),
        g: wp.array2d(dtype=scalar),
        z: wp.array2d(dtype=scalar),
        s: wp.array3d(dtype=scalar),
        w: wp.array3d(dtype=scalar),
    ):
        """Update load cases with an accepted step: u += t d, g = g', z = z'; store the pair and the new direction d."""
        block, c = wp.tid()
        if accepted[c] == 0:
            return
        taken, last, n = scalar(step_length[c]), u.shape[0] - 1, slot[c]
        step, direction = few_scalars(), few_scalars()
        for k in range(few):
            r = wp.min(few * block + k, last)
            step[k] = taken * d[r, c]
            direction[k] = -new_z[r, c]
            if n >= 0:
                s[n, r, c] = step[k]
                w[n, r, c] = new_z[r, c] - z[r, c]
        size = pair_count[c]
        for i in range(m):  # unrolled: address arithmetic dominates
            if i < size:
                for k in range(few):
                    r = wp.min(few * block + k, last)
                    direction[k] += weights_w[i, c] * w[i, r, c] + weights_s[i, c] * s[i, r, c]
        live = status[c] == LIVE
        for k in range(few):
            r = few * block + k
            if r <= last:
                u[r, c] += step[k]
                if live:
                    g[r, c] = new_g[r, c]
                    z[r, c] = new_z[r, c]
                    d[r, c] = direction[k]

    @forward_kernel(module="unique")
    def limit_step(
        # outputs
        max_length: wp.array(dtype=scalar),
        t: wp.array(dtype=wp.float64),
    ):
        """Limit the step length t to `max_length`, and reset the bound to 1."""
        c = wp.tid()
        t[c] = wp.min(t[c], wp.float64(max_length[c]))
        max_length[c] = scalar(1.0)

    return LbfgsKernels(add_gradient, compute_products, check_step, set_direction, accept_step, limit_step)

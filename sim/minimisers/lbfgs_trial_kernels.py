"""Kernels of a trial step of L-BFGS: the trial point and its projected gradient.

With many load cases, adjacent threads compute adjacent load cases, each with a few rows. With one load case, this would
use few threads with memory accesses far apart; so adjacent threads compute adjacent rows, and their values are summed
before the atomic addition.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.columns import get_warp_width, sum_warp
from ..runtime.device import Device, forward_kernel
from .lbfgs_kernels import FREE, GZ, GZ_OLD, OWN, ROWS_PER_THREAD, SLOPE, WHOLE, YW

ROWS_PER_CUDA_THREAD = 2  # Rows, or nodes, of a single load case per thread on CUDA.
ROWS_PER_CPU_THREAD = 1024  # The same on the CPU.


@dataclass(frozen=True)
class ThreadSpread:
    """Distribution of rows or nodes to threads: groups of `lanes` adjacent threads, `rows_per_thread` rows each."""

    lanes: int
    rows_per_thread: int

    def count_threads(self, count: int) -> int:
        """Return the number of threads for `count` rows or nodes."""
        return -(-count // (self.lanes * self.rows_per_thread)) * self.lanes


def choose_thread_spread(device: Device, columns: int) -> ThreadSpread:
    """Return the distribution of rows to threads for a device and a batch of `columns` load cases."""
    if columns > 1:
        return ThreadSpread(1, ROWS_PER_THREAD)
    return ThreadSpread(get_warp_width(device), ROWS_PER_CUDA_THREAD if device.on_cuda else ROWS_PER_CPU_THREAD)


@wp.func
def get_first_row(thread: int, lanes: int, rows_per_thread: int):
    """Return the first row of a thread; the next rows of the thread follow at intervals of `lanes`."""
    return thread // lanes * lanes * rows_per_thread + thread % lanes


@wp.func
def return_value(value: wp.float64) -> wp.float64:
    """Return the value itself; this replaces `sum_warp` if no other thread has a part of the same sum."""
    return value


@dataclass(frozen=True)
class LbfgsTrialKernels:
    """Trial step kernels for one scalar type and distribution, launched over (threads of rows or nodes, load cases)."""

    compute_trial: wp.Kernel
    project_gradient: wp.Kernel


@cache
def build_kernels(device: Device, spread: ThreadSpread) -> LbfgsTrialKernels:
    """Return the trial step kernels for the scalar type of a device."""
    scalar, vec = device.scalar, device.vector
    lanes, each = spread.lanes, spread.rows_per_thread
    together = sum_warp if lanes > 1 else return_value
    own_row, whole_row, free_row, slope_row = OWN, WHOLE, FREE, SLOPE

    @forward_kernel(module="unique")
    def compute_trial(
        u: wp.array2d(dtype=scalar),
        t: wp.array(dtype=wp.float64),
        d: wp.array2d(dtype=scalar),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """Compute the trial point v = u + t_c d."""
        thread, c = wp.tid()
        length, first = scalar(t[c]), get_first_row(thread, lanes, each)
        for k in range(each):
            r = first + lanes * k
            if r < u.shape[0]:
                v[r, c] = u[r, c] + length * d[r, c]

    @forward_kernel(module="unique")
    def project_gradient(
        constant_gradient: wp.array2d(dtype=scalar),
        fixed: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        d: wp.array2d(dtype=scalar),
        # outputs
        total: wp.array2d(dtype=scalar),
        sums: wp.array2d(dtype=wp.float64),
    ):
        """Project the gradient `total` to `free`; add |total - constant|^2, |total|^2, |free|^2, free . d to sums."""
        thread, c = wp.tid()
        own, whole, free, slope = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        first = get_first_row(thread, lanes, each)
        for i in range(first, wp.min(first + lanes * each, fixed.shape[0]), lanes):
            x = vec(total[3 * i, c], total[3 * i + 1, c], total[3 * i + 2, c])
            y = x - vec(constant_gradient[3 * i, c], constant_gradient[3 * i + 1, c], constant_gradient[3 * i + 2, c])
            own += wp.float64(wp.dot(y, y))
            whole += wp.float64(wp.dot(x, x))
            n = normal[i]
            x -= wp.dot(n, x) * n
            for k in range(3):
                f = wp.where(fixed[i, k] == wp.int8(0), x[k], scalar(0.0))
                total[3 * i + k, c] = f
                free += wp.float64(f) * wp.float64(f)
                slope += wp.float64(f) * wp.float64(d[3 * i + k, c])
        own, whole, free, slope = together(own), together(whole), together(free), together(slope)
        if thread % lanes == 0:
            wp.atomic_add(sums, own_row, c, own)
            wp.atomic_add(sums, whole_row, c, whole)
            wp.atomic_add(sums, free_row, c, free)
            wp.atomic_add(sums, slope_row, c, slope)

    return LbfgsTrialKernels(compute_trial, project_gradient)


@cache
def build_multiply_kernel(device: Device, max_pairs: int) -> wp.Kernel:
    """Return the kernel `compute_products` for a single load case, launched over (products, threads of rows)."""
    scalar, m, spread = device.scalar, max_pairs, choose_thread_spread(device, 1)
    lanes, each = spread.lanes, spread.rows_per_thread
    gz_row, gold_row, yw_row = 2 * m + GZ, 2 * m + GZ_OLD, 2 * m + YW

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
        """Compute inner products: of the new gradient g' with each s and w, with z' and z (z = M^-1 g); y . w."""
        product, thread = wp.tid()
        pair = product % m
        if product < 2 * m and pair >= pair_count[0]:
            return  # uniform over the warp, so `sum_warp` below stays valid
        total, first = wp.float64(0.0), get_first_row(thread, lanes, each)
        for k in range(each):
            r = first + lanes * k
            if r < g.shape[0]:
                x, y = scalar(new_g[r, 0]), scalar(0.0)
                if product < m:
                    y = s[pair, r, 0]
                elif product < 2 * m:
                    y = w[pair, r, 0]
                elif product == gz_row:
                    y = new_z[r, 0]
                elif product == gold_row:
                    y = z[r, 0]
                elif product == yw_row:
                    x -= g[r, 0]
                    y = new_z[r, 0] - z[r, 0]
                total += wp.float64(x) * wp.float64(y)
        total = sum_warp(total)
        if thread % lanes == 0:
            wp.atomic_add(products, product, 0, total)

    return compute_products

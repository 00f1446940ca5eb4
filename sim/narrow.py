"""The kernels of L-BFGS for one column: neighbouring threads take neighbouring rows, and sum before they add.

With many columns neighbouring threads take neighbouring columns, and each a few rows: what `steering` does. With one
column that leaves a card idle, and its few threads far apart in memory.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from .device import Device
from .lanes import lanes_of, summed
from .steering import FREE, GOLD, GZ, OWN, SLOPE, WHOLE, YW

# Rows, or nodes, that one thread takes: on CUDA, on the CPU.
EACH, EACH_ON_CPU = 2, 1024


@dataclass(frozen=True)
class Kernels:
    """Arithmetic of one scalar type and number of pairs."""

    step: wp.Kernel
    finish: wp.Kernel
    multiply: wp.Kernel


def threads(device: Device, count: int) -> int:
    """Threads for so many rows, or nodes."""
    lanes, each = lanes_of(device), _each(device)
    return -(-count // (lanes * each)) * lanes


def _each(device: Device) -> int:
    return EACH if device.on_cuda else EACH_ON_CPU


@cache
def kernels_of(device: Device, pairs: int) -> Kernels:
    """Kernels of a device's scalar type for a column that keeps so many pairs.

    They are launched over `threads` of rows or nodes, `multiply` over (products, threads).
    """
    scalar, vec, m = device.scalar, device.vector, pairs
    lanes, each = lanes_of(device), _each(device)
    own_row, whole_row, free_row, slope_row = OWN, WHOLE, FREE, SLOPE
    gz_row, gold_row, yw_row = 2 * m + GZ, 2 * m + GOLD, 2 * m + YW

    @wp.func
    def first_of(thread: int):
        """The first of the rows that this thread takes, `lanes` apart."""
        return thread // lanes * lanes * each + thread % lanes

    @wp.kernel(module="unique")
    def step(
        u: wp.array2d(dtype=scalar),
        t: wp.array(dtype=wp.float64),
        d: wp.array2d(dtype=scalar),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """v = u + t d."""
        thread = wp.tid()
        length, first = scalar(t[0]), first_of(thread)
        for k in range(each):
            r = first + lanes * k
            if r < u.shape[0]:
                v[r, 0] = u[r, 0] + length * d[r, 0]

    @wp.kernel(module="unique")
    def finish(
        constant: wp.array2d(dtype=scalar),
        held: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        d: wp.array2d(dtype=scalar),
        # outputs
        total: wp.array2d(dtype=scalar),
        sums: wp.array2d(dtype=wp.float64),
    ):
        """Project the gradient; sums: |total - constant|^2, |total|^2, |free|^2, free . d."""
        thread = wp.tid()
        own, whole, free, slope = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        first = first_of(thread)
        for j in range(each):
            i = first + lanes * j
            if i < held.shape[0]:
                x = vec(total[3 * i, 0], total[3 * i + 1, 0], total[3 * i + 2, 0])
                y = x - vec(constant[3 * i, 0], constant[3 * i + 1, 0], constant[3 * i + 2, 0])
                own += wp.float64(wp.dot(y, y))
                whole += wp.float64(wp.dot(x, x))
                n = normal[i]
                x -= wp.dot(n, x) * n
                for k in range(3):
                    f = wp.where(held[i, k] == wp.int8(0), x[k], scalar(0.0))
                    total[3 * i + k, 0] = f
                    free += wp.float64(f) * wp.float64(f)
                    slope += wp.float64(f) * wp.float64(d[3 * i + k, 0])
        own, whole, free, slope = summed(own), summed(whole), summed(free), summed(slope)
        if thread % lanes == 0:
            wp.atomic_add(sums, own_row, 0, own)
            wp.atomic_add(sums, whole_row, 0, whole)
            wp.atomic_add(sums, free_row, 0, free)
            wp.atomic_add(sums, slope_row, 0, slope)

    @wp.kernel(module="unique")
    def multiply(
        known: wp.array(dtype=wp.int32),
        s: wp.array3d(dtype=scalar),
        w: wp.array3d(dtype=scalar),
        g: wp.array2d(dtype=scalar),
        z: wp.array2d(dtype=scalar),
        new_g: wp.array2d(dtype=scalar),
        new_z: wp.array2d(dtype=scalar),
        # outputs
        products: wp.array2d(dtype=wp.float64),
    ):
        """Products of the new gradient g' with every s, every w, z' and z; and y . w of the pair that opens now."""
        product, thread = wp.tid()
        pair = product % m
        if product < 2 * m and pair >= known[0]:
            return  # the others in step too
        total, first = wp.float64(0.0), first_of(thread)
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
        total = summed(total)
        if thread % lanes == 0:
            wp.atomic_add(products, product, 0, total)

    return Kernels(step, finish, multiply)

"""The products of L-BFGS for one column: a thread for each of them and a few rows, and sums before they are added.

With many columns a thread takes all products of its rows: what `steering` does. With one that leaves a card idle.
"""

from functools import cache

import warp as wp

from ..runtime.device import Device, forward_kernel
from ..runtime.lanes import summed
from .lbfgs_kernels import GOLD, GZ, YW
from .lbfgs_trial_kernels import first_of, spread_of


@cache
def multiply_of(device: Device, pairs: int) -> wp.Kernel:
    """The kernel for a column that keeps so many pairs, launched over (products, threads of rows)."""
    scalar, m, spread = device.scalar, pairs, spread_of(device, 1)
    lanes, each = spread.lanes, spread.each
    gz_row, gold_row, yw_row = 2 * m + GZ, 2 * m + GOLD, 2 * m + YW

    @forward_kernel(module="unique")
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
        total, first = wp.float64(0.0), first_of(thread, lanes, each)
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

    return multiply

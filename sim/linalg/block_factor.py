"""Cholesky factorisation and solution of small dense systems in double precision, one system per thread block.

Golub, Van Loan 2013, "Matrix Computations", algorithm 4.2.1 in its outer product form.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.blocks import get_block_shape, wait
from ..runtime.device import Device


@dataclass(frozen=True)
class BlockFactorFunctions:
    """Warp functions for matrices (b, n, n) and vectors (b, n); only the first `size` rows and columns are used."""

    factor: wp.Function
    solve: wp.Function


@cache
def build_functions(device: Device) -> BlockFactorFunctions:
    """Return the functions for thread blocks of a device."""
    down, across = get_block_shape(device)
    threads = down * across

    @wp.func
    def factor(a: wp.array3d(dtype=wp.float64), size: int, c: int, me: int) -> bool:
        """Factorise A = L L' in place, from the upper half of A; return False if A is not positive definite.

        In this case the contents of `a` are invalid.
        """
        i0, j0 = me // across, me % across
        for k in range(size):
            pivot = a[c, k, k]
            if not pivot > wp.float64(0.0):
                return False
            inverse = wp.float64(1.0) / pivot
            for i in range(k + 1 + i0, size, down):
                share = a[c, k, i] * inverse
                for j in range(i + j0, size, across):
                    a[c, i, j] = a[c, i, j] - share * a[c, k, j]
            wait()
        for i in range(i0, size, down):
            root = wp.sqrt(a[c, i, i])
            for j in range(i + 1 + j0, size, across):
                a[c, i, j] = a[c, i, j] / root
                a[c, j, i] = a[c, i, j]
        wait()
        for i in range(me, size, threads):
            a[c, i, i] = wp.sqrt(a[c, i, i])
        wait()
        return True

    @wp.func
    def solve(a: wp.array3d(dtype=wp.float64), size: int, c: int, me: int, x: wp.array2d(dtype=wp.float64)):
        """Solve A x = b in place in `x`, with the result of `factor`."""
        for k in range(size):
            y = x[c, k] / a[c, k, k]
            for i in range(k + 1 + me, size, threads):
                x[c, i] = x[c, i] - a[c, k, i] * y
            wait()
            if me == 0:
                x[c, k] = y
        wait()
        for n in range(size):
            k = size - 1 - n
            y = x[c, k] / a[c, k, k]
            for i in range(me, k, threads):
                x[c, i] = x[c, i] - a[c, k, i] * y
            wait()
            if me == 0:
                x[c, k] = y
        wait()

    return BlockFactorFunctions(factor, solve)

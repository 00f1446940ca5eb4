"""Cholesky factorisation and solution of small dense systems in double precision, one system per thread block.

Golub, Van Loan 2013, "Matrix Computations", algorithm 4.2.1 in its outer product form.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.blocks import get_block_shape, wait
from ..runtime.device import Device

# C++ code of y_ij += factor x_kj for columns j from `first` to `stop`: unlike Warp's indices, pointers allow SIMD.
ROW_CODE = """
    double* to = wp::address(y, c, i, 0);
    const double* from = wp::address(x, c, k, 0);
    for (int j = first; j < stop; j += STEP) to[j] += factor * from[j];
"""


@dataclass(frozen=True)
class BlockFactorFunctions:
    """Warp functions for matrices (b, n, n) and vectors (b, n); only the first `size` rows and columns are used."""

    add_row: wp.Function
    factor: wp.Function
    solve: wp.Function


@cache
def build_functions(device: Device) -> BlockFactorFunctions:
    """Return the functions for thread blocks of a device."""
    down, across = get_block_shape(device)
    threads = down * across

    @wp.func_native(ROW_CODE.replace("STEP", str(across)))
    def add_row(
        factor: wp.float64,
        x: wp.array3d(dtype=wp.float64),
        k: int,
        first: int,
        stop: int,
        c: int,
        y: wp.array3d(dtype=wp.float64),
        i: int,
    ):
        """Add `factor` times row k of x to row i of y, in this thread's columns from `first` to `stop`."""
        ...

    @wp.func
    def factor(a: wp.array3d(dtype=wp.float64), size: int, c: int, thread: int) -> bool:
        """Factorise A = L L' in place, from the upper half of A; return False if A is not positive definite.

        In this case the contents of `a` are invalid.
        """
        i0, j0 = thread // across, thread % across
        for k in range(size):
            pivot = a[c, k, k]
            if not pivot > wp.float64(0.0):
                return False
            inverse = wp.float64(1.0) / pivot
            for i in range(k + 1 + i0, size, down):
                share = a[c, k, i] * inverse
                add_row(-share, a, k, i + j0, size, c, a, i)
            wait()
        for i in range(i0, size, down):
            root = wp.sqrt(a[c, i, i])
            for j in range(i + 1 + j0, size, across):
                a[c, i, j] = a[c, i, j] / root
                a[c, j, i] = a[c, i, j]
        wait()
        for i in range(thread, size, threads):
            a[c, i, i] = wp.sqrt(a[c, i, i])
        wait()
        return True

    @wp.func
    def solve(a: wp.array3d(dtype=wp.float64), size: int, c: int, thread: int, x: wp.array2d(dtype=wp.float64)):
        """Solve A x = b in place in `x`, with the result of `factor`."""
        for k in range(size):
            y = x[c, k] / a[c, k, k]
            for i in range(k + 1 + thread, size, threads):
                x[c, i] = x[c, i] - a[c, k, i] * y
            wait()
            if thread == 0:
                x[c, k] = y
        wait()
        for n in range(size):
            k = size - 1 - n
            y = x[c, k] / a[c, k, k]
            for i in range(thread, k, threads):
                x[c, i] = x[c, i] - a[c, k, i] * y
            wait()
            if thread == 0:
                x[c, k] = y
        wait()

    return BlockFactorFunctions(add_row, factor, solve)

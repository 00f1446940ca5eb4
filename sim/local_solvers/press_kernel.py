"""Kernel that multiplies the motions of selected nodes by a symmetric matrix."""

from functools import cache
from typing import Any

import warp as wp

from ..runtime.device import Device, forward_kernel


@cache
def build_gemv_kernel(device: Device, matrix_type: Any, sum_type: Any, threads_per_row: int = 1) -> wp.Kernel:
    """Return the kernel that multiplies by the matrix of each load case, over (part, load case, row).

    `matrix_type` and `sum_type` are the types of matrix and products; `threads_per_row` threads compute a row together.
    """
    scalar = device.scalar

    @forward_kernel(module="unique")
    def add_product(
        matrix: wp.array3d(dtype=matrix_type),
        nodes: wp.array2d(dtype=wp.int32),
        motion: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add E M E' motion to out; the symmetric matrix M is read along its columns."""
        part, c, i = wp.tid()
        count = matrix.shape[2]
        chunk = (count + threads_per_row - 1) // threads_per_row
        total = sum_type(0.0)
        for j in range(part * chunk, wp.min((part + 1) * chunk, count)):
            total += sum_type(matrix[c, j, i]) * sum_type(motion[3 * nodes[c, j // 3] + j % 3, c])
        if total != sum_type(0.0):
            wp.atomic_add(out, 3 * nodes[c, i // 3] + i % 3, c, scalar(total))

    return add_product

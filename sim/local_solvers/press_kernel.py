"""Kernel that multiplies motions of some nodes by a symmetric matrix between them."""

from functools import cache
from typing import Any

import warp as wp

from ..runtime.device import Device, forward_kernel


@cache
def build_gemv_kernel(device: Device, matrix_type: Any, sum_type: Any, threads_per_row: int = 1) -> wp.Kernel:
    """Build the kernel that multiplies by each load case's matrix, over (part, load case, row).

    `matrix_type` and `sum_type` are the types of the matrix and of its products; `threads_per_row` threads share a row.
    """
    scalar = device.scalar

    @forward_kernel(module="unique")
    def press(
        matrix: wp.array3d(dtype=matrix_type),
        nodes: wp.array2d(dtype=wp.int32),
        motion: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add E M E' motion to out; M is symmetric, and read along its columns."""
        part, c, i = wp.tid()
        count = matrix.shape[2]
        chunk = (count + threads_per_row - 1) // threads_per_row
        total = sum_type(0.0)
        for j in range(part * chunk, wp.min((part + 1) * chunk, count)):
            total += sum_type(matrix[c, j, i]) * sum_type(motion[3 * nodes[c, j // 3] + j % 3, c])
        if total != sum_type(0.0):
            wp.atomic_add(out, 3 * nodes[c, i // 3] + i % 3, c, scalar(total))

    return press

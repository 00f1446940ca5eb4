"""Kernel that multiplies motions of some nodes by a symmetric matrix between them."""

from functools import cache
from typing import Any

import warp as wp

from ..runtime.device import Device, forward_kernel


@cache
def build_press_kernel(device: Device, entry: Any, number: Any, parts: int = 1) -> wp.Kernel:
    """Build the kernel that multiplies by each load case's matrix, over (part, load case, row).

    `entry` and `number` are the types of the matrix and of its products; `parts` threads share a row.
    """
    scalar = device.scalar

    @forward_kernel(module="unique")
    def press(
        matrix: wp.array3d(dtype=entry),
        nodes: wp.array2d(dtype=wp.int32),
        motion: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add E M E' motion to out; M is symmetric, and read along its columns."""
        part, c, i = wp.tid()
        count = matrix.shape[2]
        chunk = (count + parts - 1) // parts
        total = number(0.0)
        for j in range(part * chunk, wp.min((part + 1) * chunk, count)):
            total += number(matrix[c, j, i]) * number(motion[3 * nodes[c, j // 3] + j % 3, c])
        if total != number(0.0):
            wp.atomic_add(out, 3 * nodes[c, i // 3] + i % 3, c, scalar(total))

    return press

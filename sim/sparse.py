"""A sparse matrix on the device, times many columns."""

from functools import cache

import scipy.sparse as sp
import warp as wp

from .device import Device


@cache
def kernel_of(device: Device) -> wp.Kernel:
    """Kernel of a device's scalar type."""
    scalar = device.scalar

    @wp.kernel(module="unique")
    def multiply(
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        value: wp.array(dtype=scalar),
        x: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_r = sum over j of A_rj x_j."""
        r, c = wp.tid()
        total = scalar(0.0)
        for k in range(first[r], first[r + 1]):
            total += value[k] * x[column[k], c]
        out[r, c] = total

    return multiply


class Sparse:
    """A matrix (m, n) in compressed rows."""

    def __init__(self, matrix: sp.csr_array, device: Device):
        self._device = device
        self._rows = len(matrix.indptr) - 1
        self._entries = [
            device.array(matrix.indptr, wp.int32),
            device.array(matrix.indices, wp.int32),
            device.array(matrix.data),
        ]

    def times(self, x: wp.array) -> wp.array:
        """A x (m, b) of x (n, b)."""
        out = self._device.zeros(self._rows, x.shape[1])
        self._device.launch(kernel_of(self._device), out.shape, [*self._entries, x], [out])
        return out

"""A sparse matrix of small dense blocks, times many columns: Warp on a graphics card, SciPy's loops on the CPU."""

from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from .device import Device

# Up to so many columns SciPy's product by blocks is faster than the one by entries, which streams rows of columns.
FEW = 4


@cache
def kernel_of(device: Device, rows: int, columns: int) -> wp.Kernel:
    """Kernel of a device's scalar type for blocks (rows, columns)."""
    scalar = device.scalar
    mat, vec = wp.types.matrix((rows, columns), scalar), wp.types.vector(columns, scalar)
    wide = wp.types.vector(rows, scalar)

    @wp.kernel(module="unique")
    def add_product(
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        block: wp.array(dtype=mat),
        factor: scalar,
        x: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_i += factor sum over j of A_ij x_j."""
        i, c = wp.tid()
        total = wide()
        for k in range(first[i], first[i + 1]):
            part = vec()
            for m in range(columns):
                part[m] = x[columns * column[k] + m, c]
            total += block[k] * part
        for m in range(rows):
            out[rows * i + m, c] += factor * total[m]

    return add_product


class Sparse:
    """A matrix (m, n) in compressed rows of blocks."""

    def __init__(self, matrix: sp.bsr_array, device: Device):
        self._device = device
        self._size: tuple[int, int] = matrix.blocksize
        self.rows: int = self._size[0] * (len(matrix.indptr) - 1)
        self._device_entries: list[wp.array] = []
        self._by_blocks: sp.bsr_array | None = None
        self._by_entries: sp.csr_array | None = None
        if device.on_cuda:
            kind = wp.types.matrix(self._size, device.scalar)
            indices = [device.array(index, wp.int32) for index in (matrix.indptr, matrix.indices)]
            self._device_entries = [*indices, device.array(matrix.data, kind)]
        else:
            self._by_blocks = sp.bsr_array(matrix, dtype=device.precision)

    def times(self, x: wp.array) -> wp.array:
        """A x (m, b) of x (n, b)."""
        out = self._device.zeros(self.rows, x.shape[1])
        self.add_to(out, 1.0, x)
        return out

    def add_to(self, out: wp.array, factor: float, x: wp.array) -> None:
        """out (m, b) += factor A x, with x (n, b)."""
        if self._device.on_cuda:
            rows, columns = self._size
            inputs = [*self._device_entries, self._device.scalar(factor), x]
            kernel = kernel_of(self._device, rows, columns)
            self._device.launch(kernel, (self.rows // rows, x.shape[1]), inputs, [out])
            return
        host = out.numpy()  # the array itself, not a copy
        host += np.asarray(factor, host.dtype) * (self._on_host(x.shape[1]) @ x.numpy())

    def _on_host(self, columns: int) -> sp.bsr_array | sp.csr_array:
        assert self._by_blocks is not None
        if columns <= FEW:
            return self._by_blocks
        if self._by_entries is None:
            self._by_entries = sp.csr_array(self._by_blocks)
        return self._by_entries

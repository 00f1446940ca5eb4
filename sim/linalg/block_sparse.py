"""Product of a sparse matrix of small dense blocks and an array of many columns."""

from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..runtime.device import Device, forward_kernel

# Block row times x (n, b) on the CPU; blocks are stored by columns. Eight columns of x together fill vector registers.
# For a single column the rows of a block do, WIDE >= ROWS of them: the surplus belongs to the next column, or is
# padding.
ROW_CODE = """
    const int b = x.shape[1];
    int c = 0;
    for (; c + 8 <= b; c += 8) {
        real sum[ROWS][8] = {};
        for (int k = first.data[i]; k < first.data[i + 1]; ++k) {
            const real* A = block.data + (size_t)k * ROWS * COLUMNS;
            const real* X = x.data + (size_t)COLUMNS * column.data[k] * b + c;
            for (int m = 0; m < COLUMNS; ++m)
                for (int r = 0; r < ROWS; ++r)
                    for (int l = 0; l < 8; ++l) sum[r][l] += A[m * ROWS + r] * X[m * b + l];
        }
        for (int r = 0; r < ROWS; ++r)
            for (int l = 0; l < 8; ++l) out.data[((size_t)ROWS * i + r) * b + c + l] += factor * sum[r][l];
    }
    for (; c < b; ++c) {
        real sum[COLUMNS][WIDE] = {};
        for (int k = first.data[i]; k < first.data[i + 1]; ++k) {
            const real* A = block.data + (size_t)k * ROWS * COLUMNS;
            const real* X = x.data + (size_t)COLUMNS * column.data[k] * b + c;
            for (int m = 0; m < COLUMNS; ++m)
                for (int r = 0; r < WIDE; ++r) sum[m][r] += A[m * ROWS + r] * X[m * b];
        }
        for (int m = 1; m < COLUMNS; ++m)
            for (int r = 0; r < ROWS; ++r) sum[0][r] += sum[m][r];
        for (int r = 0; r < ROWS; ++r) out.data[((size_t)ROWS * i + r) * b + c] += factor * sum[0][r];
    }
"""
LANES = 4  # Scalars per vector register; WIDE is a multiple of it.


@cache
def build_kernel(device: Device, rows: int, columns: int) -> wp.Kernel:
    """Return the CUDA kernel for blocks (rows, columns) in the device's scalar type, over (block row, column of x)."""
    scalar = device.scalar
    mat, vec = wp.types.matrix((rows, columns), scalar), wp.types.vector(columns, scalar)
    wide = wp.types.vector(rows, scalar)

    @forward_kernel(module="unique")
    def add_product(
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        block: wp.array(dtype=mat),
        factor: scalar,
        x: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add factor x (sum over j of A_ij x_j) to out_i, for one column."""
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


@cache
def build_host_kernel(device: Device, rows: int, columns: int) -> wp.Kernel:
    """Return the CPU kernel for the same product, over block rows."""
    scalar, real = device.scalar, {"float32": "float", "float64": "double"}[device.precision]
    code = ROW_CODE.replace("real", real).replace("WIDE", str(-(-rows // LANES) * LANES))

    @wp.func_native(code.replace("ROWS", str(rows)).replace("COLUMNS", str(columns)))
    def add_row(
        i: int,
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        block: wp.array(dtype=scalar),
        factor: scalar,
        x: wp.array2d(dtype=scalar),
        out: wp.array2d(dtype=scalar),
    ): ...

    @forward_kernel(module="unique")
    def add_product(
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        block: wp.array(dtype=scalar),
        factor: scalar,
        x: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add factor x (sum over j of A_ij x_j) to out_i, for all columns."""
        add_row(wp.tid(), first, column, block, factor, x, out)

    return add_product


class BlockSparse:
    """Sparse matrix (m, n) in block compressed rows (BSR)."""

    def __init__(self, matrix: sp.bsr_array, device: Device):
        self._device = device
        self._size: tuple[int, int] = matrix.blocksize
        self.rows: int = self._size[0] * (len(matrix.indptr) - 1)
        indices = [device.upload(index, wp.int32) for index in (matrix.indptr, matrix.indices)]
        if device.on_cuda:
            blocks = device.upload(matrix.data, wp.types.matrix(self._size, device.scalar))
        else:
            blocks = device.upload(np.append(matrix.data.transpose(0, 2, 1), np.zeros(LANES)))
        self._entries = [*indices, blocks]

    def multiply(self, x: wp.array) -> wp.array:
        """Return A x (m, b) for x (n, b)."""
        out = self._device.allocate(self.rows, x.shape[1])
        self.add_product(out, 1.0, x)
        return out

    def add_product(self, out: wp.array, factor: float, x: wp.array) -> None:
        """Add factor x (A x) to out (m, b), for x (n, b)."""
        inputs, count = [*self._entries, self._device.scalar(factor), x], self.rows // self._size[0]
        if self._device.on_cuda:
            self._device.launch(build_kernel(self._device, *self._size), (count, x.shape[1]), inputs, [out])
        else:
            self._device.launch(build_host_kernel(self._device, *self._size), (count,), inputs, [out])

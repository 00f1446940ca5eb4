"""Triangular sweeps of one right-hand side through all fronts of a factor, by native loops."""

from collections.abc import Sequence
from functools import cache, partial
from itertools import pairwise

import numpy as np
import warp as wp

from ..accuracy import Precision
from ..runtime.device import Device, forward_kernel
from ..runtime.threads import run_concurrently
from .symbolic import Front

# Elimination: x_own becomes the first k of t = panel^T x_own, and the others are added to x_border. Four rows of a
# panel at a time read and write t once; the rows begin with zeros.
FORWARD_CODE = """
    real* x = xs.data + (size_t)column * xs.shape[1];
    real* t = work.data + (size_t)column * work.shape[1];
    for (int f = 0; f < fronts.shape[0]; ++f) {
        const wp::int64* front = fronts.data + 5 * f;
        const int first = front[0], k = front[1], n = k + front[2];
        const int* b = border.data + front[3];
        const real* p = panel.data + front[4];
        for (int i = 0; i < n; ++i) t[i] = 0;
        int c = 0;
        for (; c + 4 <= k; c += 4) {
            const real* __restrict p0 = p + (size_t)c * n;
            const real* __restrict p1 = p0 + n;
            const real* __restrict p2 = p1 + n;
            const real* __restrict p3 = p2 + n;
            const real x0 = x[first + c], x1 = x[first + c + 1], x2 = x[first + c + 2], x3 = x[first + c + 3];
            for (int i = c; i < n; ++i) t[i] += x0 * p0[i] + x1 * p1[i] + x2 * p2[i] + x3 * p3[i];
        }
        for (; c < k; ++c) {
            const real* __restrict p0 = p + (size_t)c * n;
            for (int i = c; i < n; ++i) t[i] += x[first + c] * p0[i];
        }
        for (int i = 0; i < k; ++i) x[first + i] = t[i];
        for (int i = k; i < n; ++i) x[b[i - k]] += t[i];
    }
"""
# Back substitution: x_own = panel (x_own, x_border). Sixteen sums let the compiler use vector registers.
BACKWARD_CODE = """
    real* x = xs.data + (size_t)column * xs.shape[1];
    real* t = work.data + (size_t)column * work.shape[1];
    for (int f = fronts.shape[0] - 1; f >= 0; --f) {
        const wp::int64* front = fronts.data + 5 * f;
        const int first = front[0], k = front[1], n = k + front[2];
        const int* b = border.data + front[3];
        for (int i = 0; i < k; ++i) t[i] = x[first + i];
        for (int i = k; i < n; ++i) t[i] = x[b[i - k]];
        for (int c = 0; c < k; ++c) {
            const real* p = panel.data + front[4] + (size_t)c * n;
            real sum[16] = {};
            int i = c;
            for (; i + 16 <= n; i += 16)
                for (int l = 0; l < 16; ++l) sum[l] += p[i + l] * t[i + l];
            for (; i < n; ++i) sum[0] += p[i] * t[i];
            for (int l = 1; l < 16; ++l) sum[0] += sum[l];
            x[first + c] = sum[0];
        }
    }
"""


@cache
def build_kernel(device: Device, sweep_code: str) -> wp.Kernel:
    """Return the kernel that eliminates (`FORWARD_CODE`) or back-substitutes (`BACKWARD_CODE`) rows of xs (b, n)."""
    scalar = device.scalar
    real = {"float32": "float", "float64": "double"}[device.precision]

    @wp.func_native(sweep_code.replace("real", real))
    def sweep_row(
        column: int,
        fronts: wp.array2d(dtype=wp.int64),
        border: wp.array(dtype=wp.int32),
        panel: wp.array(dtype=scalar),
        work: wp.array2d(dtype=scalar),
        xs: wp.array2d(dtype=scalar),
    ): ...

    @forward_kernel(module="unique")
    def sweep(
        fronts: wp.array2d(dtype=wp.int64),
        border: wp.array(dtype=wp.int32),
        panel: wp.array(dtype=scalar),
        # outputs
        work: wp.array2d(dtype=scalar),
        xs: wp.array2d(dtype=scalar),
    ):
        """Apply one sweep to one row of xs, a right-hand side."""
        sweep_row(wp.tid(), fronts, border, panel, work, xs)

    return sweep


# Scatter-add of the lower half of a matrix to rows and columns of another.
SCATTER_CODE = """
    for (int j = 0; j < rows.shape[0]; ++j) {
        double* to = matrix.data + (size_t)rows.data[j] * matrix.shape[1];
        const double* from = block.data + (size_t)j * block.shape[1];
        for (int i = j; i < rows.shape[0]; ++i) to[rows.data[i]] += from[i];
    }
"""


@wp.func_native(SCATTER_CODE)
def _add(block: wp.array2d(dtype=wp.float64), rows: wp.array(dtype=wp.int64), matrix: wp.array2d(dtype=wp.float64)): ...


@forward_kernel(module="unique")
def _add_lower(
    block: wp.array2d(dtype=wp.float64),
    rows: wp.array(dtype=wp.int64),
    # outputs
    matrix: wp.array2d(dtype=wp.float64),
):
    """Add `block` to `matrix` at the indices `rows`; both are transposed, so that columns are contiguous."""
    _add(block, rows, matrix)


def add_lower_block(block: np.ndarray, index: np.ndarray, matrix: np.ndarray) -> None:
    """Add the lower half of `block` (m, m) to rows and columns `index` (m,), sorted, of `matrix`, in column order.

    This kernel is ten times as fast as NumPy.
    """
    views = [wp.array(array, device="cpu", copy=False) for array in (block.T, index, matrix.T)]
    Device("cpu", "float64").launch(_add_lower, (1,), views[:2], views[2:])


class TriangularSweeps:
    """Triangular sweeps through the fronts of a factor, part by part, with the values of all panels in one array.

    All parts except the last are swept at the same time, each with its own copy of the right-hand sides.
    """

    def __init__(self, fronts: Sequence[Sequence[Front]], values: np.ndarray, precision: Precision):
        self._device = Device("cpu", precision)
        every = [front for part in fronts for front in part]
        borders = [np.zeros(0, int), *(front.border for front in every)]
        first = np.array([front.first for front in every], int)
        size = np.array([front.stop - front.first for front in every], int)
        border = np.array([len(front.border) for front in every], int)
        entries = size * (size + border)
        table = np.column_stack([first, size, border, np.cumsum(border) - border, np.cumsum(entries) - entries])
        ends = np.cumsum([0, *(len(part) for part in fronts)])
        self._fronts = [self._device.upload(part, wp.int64) for part in np.split(table, ends[1:-1])]
        self._border = self._device.upload(np.concatenate(borders), wp.int32)
        self._panel = wp.array(values, dtype=self._device.scalar, device=self._device.name, copy=False)
        self._longest = int((size + border).max(initial=0))
        unknowns = np.cumsum([0, *size])[ends].tolist()
        self._lower, self._upper = [slice(a, b) for a, b in pairwise(unknowns[:-1])], slice(*unknowns[-2:])

    def solve(self, x: np.ndarray) -> np.ndarray:
        """Return the solution (n, b) by forward and backward sweep of x (n, b), column by column."""
        if not x.size:
            return x
        columns, parts = x.shape[1], len(self._lower)
        rows = self._device.allocate(parts, columns, len(x))
        work = self._device.allocate(parts, columns, self._longest)
        values, (up, down) = rows.numpy(), (build_kernel(self._device, code) for code in (FORWARD_CODE, BACKWARD_CODE))

        def sweep(kernel: wp.Kernel, fronts: wp.array, part: int) -> None:
            inputs = [fronts, self._border, self._panel]
            self._device.launch(kernel, (columns,), inputs, [work[part], rows[part]])

        for part, own in zip(values, self._lower, strict=True):
            part[:, own] = x.T[:, own]
        values[0, :, self._upper] = x.T[:, self._upper]
        run_concurrently([partial(sweep, up, self._fronts[part], part) for part in range(parts)])
        values[0, :, self._upper] = values[:, :, self._upper].sum(axis=0)
        for kernel in (up, down):
            sweep(kernel, self._fronts[-1], 0)
        values[1:, :, self._upper] = values[0, :, self._upper]
        run_concurrently([partial(sweep, down, self._fronts[part], part) for part in range(parts)])
        solved = np.empty((len(x), columns), x.dtype)
        for part, own in zip(values, self._lower, strict=True):
            solved[own] = part[:, own].T
        solved[self._upper] = values[0, :, self._upper].T
        return solved

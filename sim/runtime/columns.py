"""Arithmetic on batches: device arrays (rows, b) with one column per load case, and selected rows of these."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from .device import Device, forward_kernel

MAX_EXACT = 4  # Batches up to this size have workspaces of exactly their width: their L-BFGS history is handed on.
# Widths of workspaces on CUDA; larger ones are multiples of the last. Arrays of these widths are kept for graphs.
WIDTHS = (*range(1, MAX_EXACT + 1), *(share * 2**k for k in range(5, 13) for share in (2, 3)), 16384)
CHUNK = 64  # Rows that one thread sums before its atomic addition to the column's total.


@dataclass(frozen=True)
class ColumnKernels:
    """Kernels for column arithmetic and row copies, for one scalar type."""

    compute_dots: wp.Kernel
    compute_single_dot: wp.Kernel
    combine: wp.Kernel
    add_multiple: wp.Kernel
    unstack: wp.Kernel
    gather_rows: wp.Kernel
    scatter_rows: wp.Kernel
    add_rows: wp.Kernel


@cache
def build_kernels(device: Device) -> ColumnKernels:
    """Return the kernels for the scalar type of a device."""
    scalar = device.scalar
    chunk, lanes = CHUNK, get_warp_width(device)

    @forward_kernel(module="unique")
    def compute_dots(
        x: wp.array2d(dtype=scalar),
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add x_rc y_rc over a chunk of rows to out_c, in double precision."""
        block, c = wp.tid()
        total = wp.float64(0.0)
        for r in range(block * chunk, wp.min((block + 1) * chunk, x.shape[0])):
            total += wp.float64(x[r, c]) * wp.float64(y[r, c])
        wp.atomic_add(out, c, total)

    @forward_kernel(module="unique")
    def compute_single_dot(
        x: wp.array2d(dtype=scalar),
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add the inner product x . y of single columns to out, with one row per thread."""
        r = wp.tid()
        total = wp.float64(0.0)
        if r < x.shape[0]:
            total = wp.float64(x[r, 0]) * wp.float64(y[r, 0])
        total = sum_warp(total)
        if r % lanes == 0:
            wp.atomic_add(out, 0, total)

    @forward_kernel(module="unique")
    def combine(
        x: wp.array2d(dtype=scalar),
        factor: wp.array(dtype=scalar),
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute out = x + factor_c y."""
        r, c = wp.tid()
        out[r, c] = x[r, c] + factor[c] * y[r, c]

    @forward_kernel(module="unique")
    def add_multiple(
        x: wp.array2d(dtype=scalar),
        factor: scalar,
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute out = x + factor y."""
        r, c = wp.tid()
        out[r, c] = x[r, c] + factor * y[r, c]

    @forward_kernel(module="unique")
    def unstack(
        x: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Copy the vectors at nodes: out_cnk = x_(3 node(n) + k)c."""
        c, n = wp.tid()
        for k in range(3):
            out[c, n, k] = wp.float64(x[3 * nodes[n] + k, c])

    @forward_kernel(module="unique")
    def gather_rows(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Copy selected rows: out_ic = x_rows(i)c."""
        i, c = wp.tid()
        out[i, c] = x[rows[i], c]

    @forward_kernel(module="unique")
    def scatter_rows(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Copy to selected rows: out_rows(i)c = x_ic."""
        i, c = wp.tid()
        out[rows[i], c] = x[i, c]

    @forward_kernel(module="unique")
    def add_rows(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add to selected rows: out_rows(i)c += x_ic."""
        i, c = wp.tid()
        out[rows[i], c] += x[i, c]

    dots = compute_dots, compute_single_dot
    return ColumnKernels(*dots, combine, add_multiple, unstack, gather_rows, scatter_rows, add_rows)


@cache
def build_copy_kernels(dtype: Any) -> tuple[wp.Kernel, wp.Kernel]:
    """Return two kernels, for arrays of the type `dtype`: copy selected columns, and copy to selected columns."""

    @forward_kernel(module="unique")
    def copy_columns(
        x: wp.array2d(dtype=dtype),
        columns: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=dtype),
    ):
        """Copy selected columns: out_rc = x_r,columns(c)."""
        r, c = wp.tid()
        out[r, c] = x[r, columns[c]]

    @forward_kernel(module="unique")
    def write_columns(
        x: wp.array2d(dtype=dtype),
        source_columns: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=dtype),
    ):
        """Copy to selected columns: out_r,columns(c) = x_r,some(c)."""
        r, c = wp.tid()
        out[r, columns[c]] = x[r, source_columns[c]]

    return copy_columns, write_columns


def find_workspace_width(device: Device, count: int) -> int:
    """Return the width of the L-BFGS workspace for `count` load cases."""
    if not device.on_cuda:
        return count
    return next((width for width in WIDTHS if width >= count), -(-count // WIDTHS[-1]) * WIDTHS[-1])


def find_widest_workspace(device: Device, count: int) -> int:
    """Return the largest workspace width that does not exceed `count` load cases; 0 if there is none."""
    if not device.on_cuda or count < 1:
        return count
    return max(count // WIDTHS[-1] * WIDTHS[-1], *(width for width in WIDTHS if width <= count))


def is_workspace_width(width: int) -> bool:
    """Return True if a workspace may have this width [load cases]."""
    return width in WIDTHS or width % WIDTHS[-1] == 0


class Workspaces:
    """Arrays by number of columns; a workspace width always has the same array, as captured graphs require."""

    def __init__(self, allocate: Callable[[int], wp.array], device: Device):
        self._make, self._device = allocate, device
        self._arrays: dict[int, wp.array] = {}

    def get_array(self, columns: int) -> wp.array:
        """Return the array with this width, which the caller may overwrite. On the CPU, only the last array is kept."""
        if columns not in self._arrays:
            graphs = self._device.on_cuda
            self._arrays = {
                width: array for width, array in self._arrays.items() if graphs and is_workspace_width(width)
            }
            self._arrays[columns] = self._make(columns)
        return self._arrays[columns]


def add_dots(device: Device, x: wp.array, y: wp.array, out: wp.array) -> None:
    """Add the inner products of the columns of x and y (rows, b) to out (b,) float64, on the device."""
    k, (rows, count) = build_kernels(device), x.shape
    if device.on_cuda and count == 1:
        lanes = get_warp_width(device)
        device.launch(k.compute_single_dot, (-(-rows // lanes) * lanes,), [x, y], [out])
    else:
        device.launch(k.compute_dots, (-(-rows // CHUNK), count), [x, y], [out])


def compute_dots(device: Device, x: wp.array, y: wp.array) -> np.ndarray:
    """Return the inner products (b,) of the columns of x and y (rows, b), on the host."""
    out = wp.zeros(x.shape[1], dtype=wp.float64, device=device.name)
    add_dots(device, x, y, out)
    return out.numpy()


def compute_norms(device: Device, x: wp.array) -> np.ndarray:
    """Return the 2-norms (b,) of the columns of x (rows, b), on the host."""
    return np.sqrt(compute_dots(device, x, x))


def combine_columns(device: Device, x: wp.array, factor: np.ndarray | float, y: wp.array, out: wp.array) -> wp.array:
    """Compute and return out = x + factor y; `factor` is (b,) on the host, or a scalar. `out` may be x."""
    kernels = build_kernels(device)
    if isinstance(factor, (int, float)):
        device.launch(kernels.add_multiple, x.shape, [x, factor, y], [out])
    else:
        device.launch(kernels.combine, x.shape, [x, device.upload(factor), y], [out])
    return out


def gather_columns(
    device: Device, x: wp.array, columns: np.ndarray | wp.array, out: wp.array | None = None
) -> wp.array:
    """Return a copy (..., k) of the given columns (k,) of x (..., b), in `out` if given."""
    index = _to_index(device, columns)
    if out is None:
        out = wp.empty((*x.shape[:-1], len(index)), dtype=x.dtype, device=device.name)
    copy_columns, _ = build_copy_kernels(x.dtype)
    device.launch(copy_columns, _flatten_rows(out).shape, [_flatten_rows(x), index], [_flatten_rows(out)])
    return out


def scatter_columns(
    device: Device, x: wp.array, columns: np.ndarray, out: wp.array, source_columns: np.ndarray | None = None
) -> None:
    """Copy x (..., k), or its columns `source_columns` (k,), to the columns `columns` (k,) of out (..., b)."""
    _, write_columns = build_copy_kernels(x.dtype)
    source_columns = np.arange(x.shape[-1]) if source_columns is None else source_columns
    inputs = [_flatten_rows(x), _to_index(device, source_columns), _to_index(device, columns)]
    device.launch(write_columns, (_flatten_rows(x).shape[0], len(source_columns)), inputs, [_flatten_rows(out)])


def unstack_columns(device: Device, x: wp.array, nodes: np.ndarray) -> np.ndarray:
    """Return the vectors (b, n, 3) of x (3N, b) at `nodes` (n,), in double precision on the host."""
    out = wp.empty((x.shape[1], len(nodes), 3), dtype=wp.float64, device=device.name)
    device.launch(build_kernels(device).unstack, out.shape[:2], [x, device.upload(nodes, wp.int32)], [out])
    return out.numpy()


def _to_index(device: Device, columns: np.ndarray | wp.array) -> wp.array:
    return columns if isinstance(columns, wp.array) else device.upload(columns, wp.int32)


def _flatten_rows(x: wp.array) -> wp.array:
    """Return a view (rows, b) of x (..., b)."""
    return x.reshape((int(np.prod(x.shape[:-1])), x.shape[-1]))


def take_rows(device: Device, x: wp.array, rows: wp.array, out: wp.array | None = None) -> wp.array:
    """Return a copy (m, b) of the given rows (m,) of x (n, b), in `out` if given."""
    if out is None:
        out = wp.empty((len(rows), x.shape[1]), dtype=x.dtype, device=device.name)
    device.launch(build_kernels(device).gather_rows, (len(rows), x.shape[1]), [x, rows], [out])
    return out


def put_rows(device: Device, x: wp.array, rows: wp.array, out: wp.array) -> None:
    """Copy x (m, b) to the given rows (m,) of out (n, b)."""
    device.launch(build_kernels(device).scatter_rows, x.shape, [x, rows], [out])


def add_rows(device: Device, x: wp.array, rows: wp.array, out: wp.array) -> None:
    """Add x (m, b) to the given rows (m,) of out (n, b); the rows must be unique."""
    device.launch(build_kernels(device).add_rows, x.shape, [x, rows], [out])


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int half = 16; half; half >>= 1) value += __shfl_down_sync(0xffffffffu, value, half);
#endif
    return value;
"""
)
def sum_warp(value: wp.float64) -> wp.float64:
    """Return the sum over the threads of a warp, valid only in the first thread; on the CPU, the value itself.

    All threads of the warp must call the function; a launch over a multiple of `get_warp_width` guarantees this.
    """
    ...


def get_warp_width(device: Device) -> int:
    """Return the number of threads of a warp."""
    return 32 if device.on_cuda else 1

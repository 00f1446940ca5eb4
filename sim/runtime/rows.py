"""Some rows of batches of columns: arrays (rows, b) on the device, a list of row numbers (m,) int32."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from .device import Device, forward_kernel


@dataclass(frozen=True)
class Kernels:
    """What moves rows of one scalar type."""

    take: wp.Kernel
    put: wp.Kernel
    add: wp.Kernel


@cache
def kernels_of(device: Device) -> Kernels:
    """Kernels of a device's scalar type."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def take(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_ic = x_rows(i)c."""
        i, c = wp.tid()
        out[i, c] = x[rows[i], c]

    @forward_kernel(module="unique")
    def put(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_rows(i)c = x_ic."""
        i, c = wp.tid()
        out[rows[i], c] = x[i, c]

    @forward_kernel(module="unique")
    def add(
        x: wp.array2d(dtype=scalar),
        rows: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_rows(i)c += x_ic."""
        i, c = wp.tid()
        out[rows[i], c] += x[i, c]

    return Kernels(take, put, add)


def rows_taken(device: Device, x: wp.array, rows: wp.array, out: wp.array | None = None) -> wp.array:
    """A copy (m, b) of some rows of x (n, b); in `out`, if it is given."""
    if out is None:
        out = wp.empty((len(rows), x.shape[1]), dtype=x.dtype, device=device.name)
    device.launch(kernels_of(device).take, (len(rows), x.shape[1]), [x, rows], [out])
    return out


def put_rows(device: Device, x: wp.array, rows: wp.array, out: wp.array) -> None:
    """Copy x (m, b) to some rows of out (n, b)."""
    device.launch(kernels_of(device).put, x.shape, [x, rows], [out])


def add_rows(device: Device, x: wp.array, rows: wp.array, out: wp.array) -> None:
    """Add x (m, b) to some rows of out (n, b), each of them once."""
    device.launch(kernels_of(device).add, x.shape, [x, rows], [out])

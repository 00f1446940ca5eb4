"""Arithmetic on batches of columns: arrays (rows, b) on the device, one column per load case."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from .device import Device

# Rows that one thread sums before it adds to the column's total.
CHUNK = 64


@dataclass(frozen=True)
class Kernels:
    """Column arithmetic of one scalar type."""

    dot: wp.Kernel
    combine: wp.Kernel
    gather: wp.Kernel
    scatter: wp.Kernel


@cache
def kernels_of(device: Device) -> Kernels:
    """Kernels of a device's scalar type."""
    scalar = device.scalar
    chunk = CHUNK

    @wp.kernel(module="unique")
    def dot(
        x: wp.array2d(dtype=scalar),
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """out_c += sum over a chunk of rows of x_rc y_rc, in double precision."""
        block, c = wp.tid()
        total = wp.float64(0.0)
        for r in range(block * chunk, wp.min((block + 1) * chunk, x.shape[0])):
            total += wp.float64(x[r, c]) * wp.float64(y[r, c])
        wp.atomic_add(out, c, total)

    @wp.kernel(module="unique")
    def combine(
        x: wp.array2d(dtype=scalar),
        factor: wp.array(dtype=scalar),
        y: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out = x + factor_c y."""
        r, c = wp.tid()
        out[r, c] = x[r, c] + factor[c] * y[r, c]

    @wp.kernel(module="unique")
    def gather(
        x: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_rc = x_r,columns(c)."""
        r, c = wp.tid()
        out[r, c] = x[r, columns[c]]

    @wp.kernel(module="unique")
    def scatter(
        x: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_r,columns(c) = x_rc."""
        r, c = wp.tid()
        out[r, columns[c]] = x[r, c]

    return Kernels(dot, combine, gather, scatter)


def add_dots(device: Device, x: wp.array, y: wp.array, out: wp.array) -> None:
    """Add the columns' inner products of x and y (rows, b) to out (b,) float64, on the device."""
    device.launch(kernels_of(device).dot, (-(-x.shape[0] // CHUNK), x.shape[1]), [x, y], [out])


def dots(device: Device, x: wp.array, y: wp.array) -> np.ndarray:
    """The columns' inner products (b,) of x and y (rows, b), on the host."""
    out = wp.zeros(x.shape[1], dtype=wp.float64, device=device.name)
    add_dots(device, x, y, out)
    return out.numpy()


def norms(device: Device, x: wp.array) -> np.ndarray:
    """The columns' 2-norms (b,) of x (rows, b), on the host."""
    return np.sqrt(dots(device, x, x))


def combined(device: Device, x: wp.array, factor: np.ndarray, y: wp.array, out: wp.array) -> wp.array:
    """out = x + factor y column by column; factor (b,) from the host; out may be x."""
    device.launch(kernels_of(device).combine, x.shape, [x, device.array(factor), y], [out])
    return out


def gathered(device: Device, x: wp.array, columns: np.ndarray) -> wp.array:
    """A copy (rows, k) of some columns (k,) of x (rows, b)."""
    out = wp.empty((x.shape[0], len(columns)), dtype=device.scalar, device=device.name)
    device.launch(kernels_of(device).gather, out.shape, [x, device.array(columns, wp.int32)], [out])
    return out


def scattered(device: Device, x: wp.array, columns: np.ndarray, out: wp.array) -> None:
    """Copy x (rows, k) to some columns (k,) of out (rows, b)."""
    device.launch(kernels_of(device).scatter, x.shape, [x, device.array(columns, wp.int32)], [out])

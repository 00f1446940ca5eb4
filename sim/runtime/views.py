"""Warp arrays as arrays of the library for their device: NumPy on the CPU, torch on a GPU."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from .device import Device
from .threads import limit_to_one_thread


def get_library(device: Device) -> Any:
    """Return the library, NumPy or torch: `linalg.solve` and array methods have the same meaning in both."""
    if device.on_cuda:
        import torch

        return torch
    return np


def to_view(array: wp.array) -> Any:
    """Return the array as the library's, without a copy."""
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()


def from_view(device: Device, values: Any) -> wp.array:
    """Return the library's array as Warp's, without a copy unless it is not contiguous."""
    values = values if device.on_cuda else np.ascontiguousarray(values)
    return wp.from_torch(values.contiguous()) if device.on_cuda else wp.array(values, device=device.name, copy=False)


def to_double(values: Any) -> Any:
    """Convert to double precision."""
    return values.astype(np.float64) if isinstance(values, np.ndarray) else values.double()


def cast_like(template: Any, values: Any) -> Any:
    """Convert to another array's precision."""
    return values.astype(template.dtype) if isinstance(values, np.ndarray) else values.to(template.dtype)


def pad_zeros(values: Any, counts: tuple[int, ...]) -> Any:
    """Append this many zeros at the end of each of the last axes."""
    shape = (
        *values.shape[: -len(counts)],
        *(old + new for old, new in zip(values.shape[-len(counts) :], counts, strict=True)),
    )
    out = np.zeros(shape, values.dtype) if isinstance(values, np.ndarray) else values.new_zeros(shape)
    out[tuple(slice(length) for length in values.shape)] = values
    return out


def rank_rows(values: Any) -> Any:
    """Return the row indices that sort each column of values (n, b) in descending order."""
    if isinstance(values, np.ndarray):
        return np.argsort(-values, axis=0, kind="stable")
    return values.argsort(dim=0, descending=True, stable=True)


def sort_columns(values: Any) -> Any:
    """Sort each column of values (n, b) in ascending order."""
    return np.sort(values, axis=0) if isinstance(values, np.ndarray) else values.sort(dim=0).values


def solve_dense(matrix: Any, right_side: Any) -> Any:
    """Solve matrix x = right; not finite where the matrix is singular. The host does not wait for the GPU."""
    if not isinstance(matrix, np.ndarray):
        import torch

        return torch.linalg.solve_ex(matrix, right_side).result
    try:
        return np.linalg.solve(matrix, right_side)
    except np.linalg.LinAlgError:
        return np.full_like(right_side, np.nan)


def to_library(device: Device, values: np.ndarray) -> Any:
    """Copy a NumPy array to the library's; on the CPU, return the array itself."""
    return wp.to_torch(wp.array(np.ascontiguousarray(values), device=device.name)) if device.on_cuda else values


def select_columns(device: Device, columns: np.ndarray, count: int) -> Any:
    """Return an index of columns (k,), ascending, of `count`: a slice for all of them, so that nothing is copied.

    On a GPU it is uploaded once for use with several arrays; NumPy indices would be uploaded each time.
    """
    return slice(None) if len(columns) == count else to_library(device, columns)


def to_host(values: Any) -> np.ndarray:
    """Return the library's array as NumPy's."""
    return values if isinstance(values, np.ndarray) else values.cpu().numpy()


@contextmanager
def run_in_order(device: Device) -> Iterator[None]:
    """Run the library's work in Warp's stream, and on the CPU with BLAS limited to one thread.

    BLAS threads wait for one another, very long where other processes use their cores.
    """
    if device.on_cuda:
        import torch

        with torch.cuda.stream(wp.stream_to_torch(device.name)):
            yield
    else:
        with limit_to_one_thread():
            yield

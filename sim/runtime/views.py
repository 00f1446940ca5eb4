"""Warp arrays as arrays of another library: NumPy on the CPU, torch on a GPU."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from .device import Device
from .threads import limit_to_one_thread


def get_library(device: Device) -> Any:
    """Return the array library of a device, NumPy or torch; `linalg.solve` and array methods are the same in both."""
    if device.on_cuda:
        import torch

        return torch
    return np


def to_view(array: wp.array) -> Any:
    """Return a Warp array as an array of the library, without a copy."""
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()


def from_view(device: Device, values: Any) -> wp.array:
    """Return an array of the library as a Warp array; only arrays that are not contiguous are copied."""
    values = values if device.on_cuda else np.ascontiguousarray(values)
    return wp.from_torch(values.contiguous()) if device.on_cuda else wp.array(values, device=device.name, copy=False)


def to_double(values: Any) -> Any:
    """Return an array of the library in double precision."""
    return values.astype(np.float64) if isinstance(values, np.ndarray) else values.double()


def cast_like(template: Any, values: Any) -> Any:
    """Return `values` in the precision of the array `template`."""
    return values.astype(template.dtype) if isinstance(values, np.ndarray) else values.to(template.dtype)


def pad_zeros(values: Any, counts: tuple[int, ...]) -> Any:
    """Return an array with the given numbers of zeros appended to each of the last axes."""
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
    """Return values (n, b) with each column sorted in ascending order."""
    return np.sort(values, axis=0) if isinstance(values, np.ndarray) else values.sort(dim=0).values


def solve_dense(matrix: Any, right_side: Any) -> Any:
    """Return the solution of matrix x = right_side, not finite for a singular matrix; the host does not wait."""
    if not isinstance(matrix, np.ndarray):
        import torch

        return torch.linalg.solve_ex(matrix, right_side).result
    try:
        return np.linalg.solve(matrix, right_side)
    except np.linalg.LinAlgError:
        return np.full_like(right_side, np.nan)


def to_library(device: Device, values: np.ndarray) -> Any:
    """Return a NumPy array as an array of the library; on the CPU, the array itself."""
    return wp.to_torch(wp.array(np.ascontiguousarray(values), device=device.name)) if device.on_cuda else values


def select_columns(device: Device, columns: np.ndarray, count: int) -> Any:
    """Return an index for sorted columns (k,) out of `count`; for all columns a slice, so that nothing is copied.

    On a GPU the index is uploaded once for several arrays; a NumPy index would be uploaded at each use.
    """
    return slice(None) if len(columns) == count else to_library(device, columns)


def to_host(values: Any) -> np.ndarray:
    """Return an array of the library as a NumPy array."""
    return values if isinstance(values, np.ndarray) else values.cpu().numpy()


@contextmanager
def run_in_order(device: Device) -> Iterator[None]:
    """Run a block of library calls in the stream of Warp or, on the CPU, with BLAS limited to one thread.

    BLAS threads wait for each other, very long if other processes use the same cores.
    """
    if device.on_cuda:
        import torch

        with torch.cuda.stream(wp.stream_to_torch(device.name)):
            yield
    else:
        with limit_to_one_thread():
            yield

"""Arrays of Warp as arrays of the library that is at home where they live: NumPy on the CPU, torch on a card."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from .device import Device
from .threads import limit_to_one_thread


def get_library(device: Device) -> Any:
    """It: `linalg.solve` and the arrays' own methods mean the same in both."""
    if device.on_cuda:
        import torch

        return torch
    return np


def view(array: wp.array) -> Any:
    """Return the same numbers, not a copy of them."""
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()


def from_view(device: Device, values: Any) -> wp.array:
    """Warp's array of the same numbers."""
    values = values if device.on_cuda else np.ascontiguousarray(values)
    return wp.from_torch(values.contiguous()) if device.on_cuda else wp.array(values, device=device.name, copy=False)


def to_double(values: Any) -> Any:
    """Return the same in double precision."""
    return values.astype(np.float64) if isinstance(values, np.ndarray) else values.double()


def cast_like(other: Any, values: Any) -> Any:
    """Return the same in another array's precision."""
    return values.astype(other.dtype) if isinstance(values, np.ndarray) else values.to(other.dtype)


def pad_zeros(values: Any, more: tuple[int, ...]) -> Any:
    """Return the same with so many more zeros at the end of each of the last axes."""
    shape = (
        *values.shape[: -len(more)],
        *(old + new for old, new in zip(values.shape[-len(more) :], more, strict=True)),
    )
    out = np.zeros(shape, values.dtype) if isinstance(values, np.ndarray) else values.new_zeros(shape)
    out[tuple(slice(length) for length in values.shape)] = values
    return out


def order_by_size(values: Any) -> Any:
    """Return the rows in the order in which each column (n, b) falls."""
    if isinstance(values, np.ndarray):
        return np.argsort(-values, axis=0, kind="stable")
    return values.argsort(dim=0, descending=True, stable=True)


def sort_columns(values: Any) -> Any:
    """Each column (n, b) sorted."""
    return np.sort(values, axis=0) if isinstance(values, np.ndarray) else values.sort(dim=0).values


def solve_dense(matrix: Any, right: Any) -> Any:
    """matrix^-1 right; not finite where that is singular. A card is not waited for."""
    if not isinstance(matrix, np.ndarray):
        import torch

        return torch.linalg.solve_ex(matrix, right).result
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


def to_library(device: Device, values: np.ndarray) -> Any:
    """Return the library's array with the same numbers; on the CPU they are these themselves."""
    return wp.to_torch(wp.array(np.ascontiguousarray(values), device=device.name)) if device.on_cuda else values


def select_columns(device: Device, some: np.ndarray, count: int) -> Any:
    """What picks some columns (k,), ascending, of `count`: all of them by a slice, so that nothing is copied.

    A card is not waited for where it stands for many arrays: each index of NumPy's would go up by itself.
    """
    return slice(None) if len(some) == count else to_library(device, some)


def to_host(values: Any) -> np.ndarray:
    """Either library's numbers as NumPy's."""
    return values if isinstance(values, np.ndarray) else values.cpu().numpy()


@contextmanager
def run_in_order(device: Device) -> Iterator[None]:
    """While in it the library's work takes turns with Warp's, and its BLAS keeps to one thread on the CPU.

    Threads of BLAS wait for one another, ages where something else runs on their cores.
    """
    if device.on_cuda:
        import torch

        with torch.cuda.stream(wp.stream_to_torch(device.name)):
            yield
    else:
        with limit_to_one_thread():
            yield

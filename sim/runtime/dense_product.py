"""Product of a dense matrix and columns by the fastest library: torch on CUDA, BLAS of NumPy on the CPU."""

from collections.abc import Callable

import numpy as np
import warp as wp

from .device import Device
from .threads import limit_to_one_thread


def build_product(matrix: np.ndarray, device: Device, is_reduced: bool = False) -> Callable[[wp.array, wp.array], None]:
    """Return a function (x, out): out (m, b) = matrix (m, n) x (n, b). `is_reduced`: CUDA rounds values to 8 bits."""
    return _build_cuda_product(matrix, device, is_reduced) if device.on_cuda else _build_cpu_product(matrix, device)


def _build_cpu_product(matrix: np.ndarray, device: Device) -> Callable[[wp.array, wp.array], None]:
    kept = matrix.astype(device.precision)

    def multiply(x: wp.array, out: wp.array) -> None:
        # BLAS threads wait for one another, very long where other processes use their cores.
        with limit_to_one_thread():
            np.matmul(kept, x.numpy(), out=out.numpy())

    return multiply


def _build_cuda_product(matrix: np.ndarray, device: Device, is_reduced: bool) -> Callable[[wp.array, wp.array], None]:
    import torch

    kind = torch.bfloat16 if is_reduced else wp.dtype_to_torch(device.scalar)
    kept = torch.as_tensor(matrix, device=wp.device_to_torch(device.name)).to(kind)

    def multiply(x: wp.array, out: wp.array) -> None:
        with torch.cuda.stream(wp.stream_to_torch(device.name)):
            if is_reduced:
                wp.to_torch(out).copy_(torch.matmul(kept, wp.to_torch(x).to(kind)))
            else:
                torch.matmul(kept, wp.to_torch(x), out=wp.to_torch(out))

    return multiply

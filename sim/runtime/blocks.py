"""Collective operations of the threads of a block, which compute one load case together; one thread on the CPU."""

from typing import Any

import warp as wp

from .device import Device


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""
)
def wait():
    """Wait until all threads of the block have arrived here, and their writes are visible."""
    ...


def write_reduction_code(operation: str) -> str:
    """Return C++ code of a reduction over the threads, equal bits in all; `operation` combines `value` and `other`."""
    return f"""
#if defined(__CUDA_ARCH__)
    __shared__ double shares[32];
    for (int away = 16; away > 0; away /= 2) {{
        const double other = __shfl_xor_sync(0xffffffffu, value, away);
        value = {operation};
    }}
    __syncthreads();
    if (threadIdx.x % 32 == 0) shares[threadIdx.x / 32] = value;
    __syncthreads();
    value = shares[0];
    for (int warp = 1; warp < blockDim.x / 32; ++warp) {{
        const double other = shares[warp];
        value = {operation};
    }}
#endif
    return value;
"""


@wp.func_native(snippet=write_reduction_code("value + other"))
def get_sum(value: wp.float64) -> wp.float64:
    """Return the sum of the values of all threads."""
    ...


@wp.func_native(snippet=write_reduction_code("fmax(value, other)"))
def get_max(value: wp.float64) -> wp.float64:
    """Return the maximum of the values of all threads."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ int shares[32];
    const int place = threadIdx.x % 32, warp = threadIdx.x / 32;
    int upto = value;
    for (int away = 1; away < 32; away *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, upto, away);
        if (place >= away) upto += other;
    }
    __syncthreads();
    if (place == 31) shares[warp] = upto;
    __syncthreads();
    for (int other = 0; other < warp; ++other) upto += shares[other];
    return upto - value;
#else
    return 0;
#endif
"""
)
def get_prefix(value: wp.int32) -> wp.int32:
    """Return the sum of the values of all preceding threads."""
    ...


def get_block_shape(device: Device) -> tuple[int, int]:
    """Return the number of threads of a block as (rows, columns); on a GPU, whole warps."""
    return (16, 32) if device.on_cuda else (1, 1)


def launch(device: Device, kernel: wp.Kernel, columns: int, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel over (load case, thread), for `columns` load cases."""
    rows, along = get_block_shape(device)
    device.launch(kernel, (columns, rows * along), inputs, outputs, rows * along)

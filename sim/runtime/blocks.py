"""Columns that a block of threads has to itself: what its threads do together. On the CPU a block is one thread."""

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
    """Until all threads of the block are here, and see what all have written."""
    ...


@wp.func
def total(value: wp.float64, c: int, me: int, room: wp.array2d(dtype=wp.float64)) -> wp.float64:
    """The sum over the threads, with room (b, threads) for their shares: of the same bits in each of them."""
    room[c, me] = value
    wait()
    out = wp.float64(0.0)
    for i in range(room.shape[1]):
        out += room[c, i]
    wait()
    return out


def threads_of(device: Device) -> tuple[int, int]:
    """How many threads a block has, as rows and columns."""
    return (8, 16) if device.on_cuda else (1, 1)


def launch(device: Device, kernel: wp.Kernel, columns: int, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel over (column, thread)."""
    rows, along = threads_of(device)
    if columns:
        wp.launch(
            kernel,
            dim=(columns, rows * along),
            inputs=inputs,
            outputs=outputs,
            device=device.name,
            block_dim=rows * along,
            record_tape=False,
        )

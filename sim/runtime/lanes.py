"""Sums over threads that run in step: on CUDA thirty-two of them add up before one touches memory."""

import warp as wp

from .device import Device


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int half = 16; half; half >>= 1) value += __shfl_down_sync(0xffffffffu, value, half);
#endif
    return value;
"""
)
def summed(value: wp.float64) -> wp.float64:
    """The sum over the threads that run in step, valid in the first of them; on the CPU the value itself.

    All of them must be here, which launches over multiples of `lanes_of` see to.
    """
    ...


def lanes_of(device: Device) -> int:
    """How many threads run in step."""
    return 32 if device.on_cuda else 1

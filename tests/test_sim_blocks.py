"""Collective operations of a block's threads against NumPy; on the CPU a block is one thread."""

import numpy as np
import pytest
import warp as wp

from sim.runtime.blocks import get_block_shape, get_max, get_prefix, get_sum, launch
from sim.runtime.device import Device, forward_kernel

ON_A_CARD = pytest.param(
    "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")]
)


@pytest.mark.parametrize("name", ["cpu", ON_A_CARD])
def test_block_scan_returns_sum_maximum_and_prefix(name: str) -> None:
    device, count = Device(name, "float64"), 3
    threads = int(np.prod(get_block_shape(device)))

    @forward_kernel(module="unique")
    def run(given: wp.array2d(dtype=wp.float64), out: wp.array3d(dtype=wp.float64)):
        c, me = wp.tid()
        out[0, c, me] = get_sum(given[c, me])
        out[1, c, me] = get_max(given[c, me])
        out[2, c, me] = wp.float64(get_prefix(wp.int32(given[c, me])))

    given = np.random.default_rng(0).integers(1, 100, (count, threads)).astype(float)
    out = wp.zeros((3, count, threads), dtype=wp.float64, device=device.name)
    launch(device, run, count, [device.upload(given)], [out])
    sums, most, passed = out.numpy()
    np.testing.assert_array_equal(sums, np.broadcast_to(given.sum(axis=1, keepdims=True), given.shape))
    np.testing.assert_array_equal(most, np.broadcast_to(given.max(axis=1, keepdims=True), given.shape))
    np.testing.assert_array_equal(passed, given.cumsum(axis=1) - given)

"""Small dense systems that blocks of threads solve, against NumPy's."""

import numpy as np
import pytest
import warp as wp

from sim.linalg.block_factor import build_functions
from sim.runtime.blocks import launch
from sim.runtime.device import Device, forward_kernel

ON_A_CARD = pytest.param(
    "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")]
)


@pytest.mark.parametrize("name", ["cpu", ON_A_CARD])
def test_block_factor_and_solution_agree_with_numpy(name: str) -> None:
    """Only the first `size` rows count, and a matrix that is not positive definite is reported."""
    device, size, count = Device(name, "float64"), 37, 3
    functions = build_functions(device)
    factor, solve = functions.factor, functions.solve

    @forward_kernel(module="unique")
    def run(a: wp.array3d(dtype=wp.float64), x: wp.array2d(dtype=wp.float64), size: int, out: wp.array(dtype=wp.int32)):
        c, me = wp.tid()
        positive = factor(a, size, c, me)
        if positive:
            solve(a, size, c, me, x)
        if me == 0:
            out[c] = wp.where(positive, 1, 0)

    rng = np.random.default_rng(0)
    roots = rng.normal(size=(count, size, size))
    matrix = roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(size)
    matrix[1] -= 30.0 * np.eye(size)
    assert np.linalg.eigvalsh(matrix[1])[0] < 0.0
    right = rng.normal(size=(count, size))
    whole = np.full((count, size + 4, size + 4), np.nan)
    whole[:, :size, :size] = np.triu(matrix)
    a, x = device.upload(whole), device.upload(np.hstack([right, np.full((count, 4), np.nan)]))
    said = wp.zeros(count, dtype=wp.int32, device=device.name)
    launch(device, run, count, [a, x, size], [said])
    assert said.numpy().tolist() == [1, 0, 1]
    for column in (0, 2):
        np.testing.assert_allclose(x.numpy()[column, :size], np.linalg.solve(matrix[column], right[column]), rtol=1e-8)
        lower = np.tril(a.numpy()[column, :size, :size])
        np.testing.assert_allclose(lower @ lower.T, matrix[column], rtol=1e-9, atol=1e-9)

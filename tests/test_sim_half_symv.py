"""Products with half of a symmetric matrix, in half precision on CUDA."""

import numpy as np
import pytest
import warp as wp

from sim.linalg.half_symv import add_product, list_tiles


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
def test_half_symmetric_product_agrees_with_full_matrix():
    size = 64 * 13  # no multiple of a tile
    random = np.random.default_rng(0)
    matrix, x = random.normal(size=(size, size)).astype(np.float16), random.normal(size=size).astype(np.float32)
    whole = np.triu(matrix) + np.triu(matrix, 1).T
    matrix, x = wp.array(whole, dtype=wp.float16, device="cuda"), wp.array(x, device="cuda")
    y = wp.full(size, 1.0, dtype=wp.float32, device="cuda")
    add_product(list_tiles(size, "cuda"), matrix, x, y)
    np.testing.assert_allclose(y.numpy(), 1.0 + whole.astype(float) @ x.numpy(), atol=1e-3)

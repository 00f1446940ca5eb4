"""Products of block matrices against SciPy's."""

import numpy as np
import pytest
import scipy.sparse as sp

from sim.linalg.block_sparse import BlockSparse
from sim.runtime.device import Precision, find_device


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("float64", 1e-13)])
@pytest.mark.parametrize("size", [(3, 3), (3, 6), (6, 3), (6, 6)])
@pytest.mark.parametrize("width", [1, 3, 8, 19])
def test_block_product_matches_scipy(size: tuple[int, int], width: int, precision: Precision, tolerance: float) -> None:
    """Any number of columns; the third block row is empty, the last one is full."""
    random, device = np.random.default_rng(0), find_device("cpu", precision)
    there = random.random((7, 5)) < 0.4
    there[2], there[6] = False, True
    dense = np.kron(there, np.ones(size)) * random.normal(size=(7 * size[0], 5 * size[1]))
    matrix = BlockSparse(sp.bsr_array(dense, blocksize=size), device)
    x, out = random.normal(size=(5 * size[1], width)), random.normal(size=(7 * size[0], width))
    added = device.upload(out)
    matrix.add_product(added, -0.5, device.upload(x))
    np.testing.assert_allclose(added.numpy(), out - 0.5 * dense @ x, atol=tolerance * np.abs(dense @ x).max())
    np.testing.assert_allclose(matrix.multiply(device.upload(x)).numpy(), dense @ x, atol=tolerance * 20)

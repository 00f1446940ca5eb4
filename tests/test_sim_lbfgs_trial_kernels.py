"""Kernels for one column, whose rows threads share, against those for many columns."""

import numpy as np
import pytest
import warp as wp

from sim.minimisers import lbfgs_trial_kernels
from sim.minimisers.lbfgs_kernels import PAIRS, PRODUCTS, ROWS_PER_THREAD, SUMS, build_kernels
from sim.minimisers.lbfgs_trial_kernels import build_multiply_kernel, choose_thread_spread
from sim.runtime.device import find_device

NODES = 1500
"""More than one thread takes."""
ROWS = 3 * NODES
DEVICE = find_device("cpu", "float64")
ONE, MANY = choose_thread_spread(DEVICE, 1), choose_thread_spread(DEVICE, 2)
RNG = np.random.default_rng(0)


def column(*shape: int) -> wp.array:
    return DEVICE.upload(RNG.normal(size=(*shape, 1)))


def double(*shape: int) -> wp.array:
    return wp.zeros(shape, dtype=wp.float64, device="cpu")


def test_step_kernels_for_one_and_many_columns_agree():
    u, d, t, one, many = column(ROWS), column(ROWS), double(1), column(ROWS), column(ROWS)
    t.fill_(0.3)
    for spread, out in ((ONE, one), (MANY, many)):
        DEVICE.launch(
            lbfgs_trial_kernels.build_kernels(DEVICE, spread).compute_trial,
            (spread.count_threads(ROWS), 1),
            [u, t, d],
            [out],
        )
    np.testing.assert_array_equal(one.numpy(), many.numpy())


def test_gradient_kernels_for_one_and_many_columns_agree():
    held = DEVICE.upload(RNG.integers(0, 2, (NODES, 3)), wp.int8)
    normals = RNG.normal(size=(NODES, 3)) * RNG.integers(0, 2, (NODES, 1))
    normal = DEVICE.upload(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9), DEVICE.vector)
    constant, d, total = column(ROWS), column(ROWS), column(ROWS)
    one, many, sums, other = wp.clone(total), wp.clone(total), double(SUMS, 1), double(SUMS, 1)
    inputs = [constant, held, normal, d]
    for spread, out in ((ONE, [one, sums]), (MANY, [many, other])):
        DEVICE.launch(
            lbfgs_trial_kernels.build_kernels(DEVICE, spread).project_gradient,
            (spread.count_threads(NODES), 1),
            inputs,
            out,
        )
    np.testing.assert_array_equal(one.numpy(), many.numpy())
    np.testing.assert_allclose(sums.numpy(), other.numpy(), rtol=1e-12)


@pytest.mark.parametrize("count", [0, 3, PAIRS])
def test_pair_product_kernels_for_one_and_many_columns_agree(count):
    s, w, vectors = column(PAIRS, ROWS), column(PAIRS, ROWS), [column(ROWS) for _ in range(4)]
    known = wp.array([count], dtype=wp.int32, device="cpu")
    one, many = double(2 * PAIRS + PRODUCTS, 1), double(2 * PAIRS + PRODUCTS, 1)
    inputs, dim = [known, s, w, *vectors], (len(one), ONE.count_threads(ROWS))
    DEVICE.launch(build_multiply_kernel(DEVICE, PAIRS), dim, inputs, [one])
    DEVICE.launch(build_kernels(DEVICE, PAIRS).compute_products, (-(-ROWS // ROWS_PER_THREAD), 1), inputs, [many])
    np.testing.assert_allclose(one.numpy(), many.numpy(), rtol=1e-9, atol=1e-9)
    assert np.count_nonzero(one.numpy()) == 2 * count + PRODUCTS

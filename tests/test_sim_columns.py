"""Kernels over columns."""

import numpy as np
from test_sim_lbfgs_trial_kernels import DEVICE, ROWS, column, double

from sim.runtime.columns import add_dots


def test_dot_product_kernel_adds_to_its_output():
    x, y, out = column(ROWS), column(ROWS), double(1)
    out.fill_(2.0)
    add_dots(DEVICE, x, y, out)
    np.testing.assert_allclose(out.numpy(), 2.0 + (x.numpy() * y.numpy()).sum())

"""Principal-component regression."""

import numpy as np
from test_surrogate_protocol import RANDOM

from surrogate.regressors.pcr import Pcr


def test_principal_components_of_little_variance_are_left_out():
    """A component of a thousandth of the variance is dropped, and with it what hangs on it alone."""
    scores = np.random.default_rng(5).normal(size=(200, 3)) * [10.0, 3.0, 0.1]
    turned = np.linalg.qr(RANDOM.normal(size=(6, 3)))[0]
    X, Y = scores @ turned.T + 7.0, scores / [10.0, 3.0, 0.1] + 2.0
    few, all_ = Pcr(share=0.999).fit(X, Y), Pcr(share=1.0).fit(X, Y)
    assert np.allclose(all_.predict(X), Y, atol=1e-5)
    assert np.allclose(few.predict(X)[:, :2], Y[:, :2], atol=0.3) and few.predict(X)[:, 2].std() < 0.3
    assert np.linalg.matrix_rank(few.map_, tol=1e-9) == 2

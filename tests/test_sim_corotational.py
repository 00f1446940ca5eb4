"""The corotational law's own rotation."""

import numpy as np
from oracle import nearest_rotation, tissue
from test_sim_law import gradients

from sim.terms.laws.conformance import build_evaluator


def test_corotational_law_uses_the_nearest_proper_rotation() -> None:
    """With lambda = 0, F - P / (2 mu) is the rotation that the law used."""
    evaluate = build_evaluator(tissue("corotational", poisson=0.0), "float64")
    F = np.eye(3) + gradients("corotational")
    R = F - evaluate(F - np.eye(3)).stress / (2.0 * evaluate.tissue.lame[0])
    assert (np.linalg.det(F) < 0.0).any()
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-11)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-11)
    np.testing.assert_allclose(R, nearest_rotation(F), atol=1e-9)

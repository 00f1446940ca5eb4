"""Nodes projected onto a level of a field."""

import numpy as np

from sim.bodies.signed_distance import project_onto_level


def test_projection_keeps_nodes_where_gradient_is_tiny():
    """The gradient of the flat field is round-off."""
    points = np.random.default_rng(0).normal(scale=0.01, size=(20, 3))
    moved = project_onto_level(lambda at: 2e-3 + 1e-6 * at[:, 0], points, np.zeros(20))
    assert np.abs(moved - points).max() < 1e-6
    steep = project_onto_level(lambda at: 0.2 * at[:, 0], points, np.zeros(20))
    np.testing.assert_allclose(steep[:, 0], 0.0, atol=1e-9)

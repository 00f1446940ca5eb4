"""Random points on a cortex."""

import numpy as np
import pytest

from surrogate.data.cortex_patch import Patch


def test_sampled_points_are_uniform_within_triangles():
    """Two triangles, one nine times as large; each quarter of the large one gets the same share."""
    points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    two = Patch(np.arange(5), np.array([[0, 1, 2], [0, 3, 4]]), points)
    found, _ = two.place_points(np.random.default_rng(0).random((20_000, 3)))
    large = found[found[:, 0] > 0.0]
    assert len(large) == pytest.approx(18_000, rel=0.01)
    beside = large[:, :2] / 3.0  # of the corners beside the right angle
    share = np.column_stack([1.0 - beside.sum(axis=1), beside])
    assert (share > 0.5).mean(axis=0) == pytest.approx([0.25] * 3, abs=0.015)
    assert two.compute_coverage(np.array([[-0.5, -0.5, 0.0]]), 0.71) == pytest.approx(0.1, abs=0.02)

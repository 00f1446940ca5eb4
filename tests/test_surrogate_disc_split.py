"""Whole discs of the cortex that are left out for tests."""

import numpy as np
import pytest
from test_surrogate_tool_loads import pushes

from sim.errors import InputError
from surrogate.data.disc_split import leave_discs_out


def test_whole_discs_are_left_out(box, patch):
    points = pushes("palpation", box, 600, 0).point
    split = leave_discs_out(points, patch)
    distance = np.linalg.norm(points[:, None] - split.centres, axis=2)
    assert split.radius == 6e-3 and len(split.centres) >= 6 and split.share >= 0.15
    assert np.array_equal(split.test, distance.min(axis=1) <= 6e-3)  # none stays inside, none is taken outside
    assert set(split.disc[split.test]) == set(range(len(split.centres)))
    assert 0.1 < split.test.mean() <= 0.5


def test_a_wide_patch_gets_more_discs(box, patch):
    points = pushes("palpation", box, 300, 0).point
    centres = leave_discs_out(points, patch).centres
    wide = type(patch)(patch.nodes, patch.triangles, 3.0 * patch.points)
    split = leave_discs_out(3.0 * points, wide)
    assert split.share >= 0.15 and len(split.centres) > len(centres)


def test_loads_at_few_positions_are_left_out_by_position(box, patch):
    points = pushes("seed", box, 2000, 0).point
    split = leave_discs_out(points, patch)
    assert len(split.centres) == 6 and len(np.unique(points[split.test], axis=0)) == 6
    assert len(np.unique(points[~split.test], axis=0)) == 5


def test_discs_shrink_where_they_would_take_more_than_half(patch):
    points = np.random.default_rng(0).normal(0, 5e-3, (500, 3)) * [1, 1, 0]
    split = leave_discs_out(points, patch)
    assert split.radius < 6e-3 and split.test.mean() <= 0.5 and len(split.centres) >= 6


def test_too_few_positions_are_refused(patch):
    with pytest.raises(InputError, match="simulate more"):
        leave_discs_out(np.repeat(np.eye(3)[:2] * 0.01, 5, axis=0), patch)

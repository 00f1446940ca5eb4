"""Inspection of an anatomy."""

import numpy as np

from scenes.commands.inspection import describe_axes


def test_describe_axes_names_anatomical_directions():
    turned = np.eye(4)
    turned[:3, :3] = np.array([[0.0, 0.2, 1.0], [-1.0, 0.1, 0.0], [0.1, -1.0, 0.2]])
    assert describe_axes(turned) == "PIR"

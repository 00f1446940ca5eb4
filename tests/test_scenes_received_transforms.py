"""Transforms received from a tracker: matrices, units and frames."""

import numpy as np
import pytest
from test_scenes_messages import STAMP, matrix

from scenes.link.frame import BadMessageError
from scenes.link.received_transforms import ReceivedTransforms, TransformNames, to_rigid


def changed(row, column, value):
    T = matrix()
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("T", "why"),
    [
        (changed(0, 0, np.nan), "not finite"),
        (changed(1, 3, np.inf), "not finite"),
        (matrix() @ np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrors"),
        (matrix() @ np.diag([1.01, 1.01, 1.01, 1.0]), "scales"),
        (np.zeros((4, 4)), "scales"),
        (matrix((0.0, 2e4, 0.0)), "more than 10 m"),
    ],
)
def test_non_rigid_matrix_is_rejected(T, why):
    with pytest.raises(BadMessageError, match=why):
        to_rigid(T)


def test_single_precision_rigid_matrix_is_converted_to_metres():
    T = to_rigid(matrix().astype(np.float32).astype(float))
    assert T[:3, 3] == pytest.approx([0.01, -0.02, 0.03]) and T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3))


def test_poses_in_tracker_frame_are_converted_to_reference():
    names = TransformNames(tool="StylusTipToTracker")
    heard = ReceivedTransforms(names, 0.3).add_transform(names.tool, matrix(), STAMP, 1.0, 0)
    assert heard.find_relative_transform(names.tool, 1.0) == "no ReferenceToTracker yet"
    heard = heard.add_transform(names.reference, matrix((0.0, 0.0, 100.0)), STAMP, 0.9, 0)
    found = heard.find_relative_transform(names.tool, 1.0)
    expected = np.linalg.inv(to_rigid(matrix((0.0, 0.0, 100.0)))) @ to_rigid(matrix())
    assert pytest.approx(expected) == found.T and found.arrived == 0.9
    assert heard.find_relative_transform(names.tool, 1.25) == "no new ReferenceToTracker for 0.3 s"

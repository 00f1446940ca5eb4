"""Targets with marker faces, and their corners in an image."""

import numpy as np
import pytest
from test_ar_pose import CUBE, PLATE

from ar.tracking.targets import BORDER_WIDTH, build_calibration_board


def test_faces_point_outwards_and_marker_ids_are_unique():
    for number, face in enumerate(CUBE.faces):
        into = face.T_target_face[:3, 2]
        np.testing.assert_allclose(into, -np.eye(3)[number])
        np.testing.assert_allclose(face.corners @ into, -(2.5 * face.square + BORDER_WIDTH))
        assert face.corners.shape == (16, 3) and np.linalg.det(face.T_target_face) == pytest.approx(1.0)
        np.testing.assert_allclose(np.ptp(face.outline, axis=0).max(), 40e-3)
    ids = [
        number for target in (CUBE, PLATE, build_calibration_board()) for face in target.faces for number in face.ids
    ]
    assert len(ids) == len(set(ids)) == 79 and max(ids) < 250

"""Errors of a calibration that a pose does not take up."""

import cv2
import numpy as np
import pytest
from test_scenes_error_parts import turned

from ar.optics.camera import Camera
from ar.tracking.intrinsics import calibration_error
from ar.tracking.targets import patient_reference


def test_calibration_error_is_what_the_pose_leaves_of_it():
    """A focal length that is 0.2 % off: the pose is fitted again, and a place beside the target is seen elsewhere."""
    T, corners, place = turned("x", 25.0), patient_reference().faces[0].corners, np.array([0.1, 0.05, 0.03])
    T[:3, 3], own = (0.0, 0.02, 0.4), np.zeros((9, 9))
    own[:2, :2] = 4.0
    right, wrong = (np.array([[focal, 0.0, 400.0], [0.0, focal, 300.0], [0.0, 0.0, 1.0]]) for focal in (1e3, 1002.0))
    turn, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3].copy()
    pixels = cv2.projectPoints(corners, turn, shift, right, None)[0]
    again = cv2.solvePnP(corners, pixels, wrong, None, turn.copy(), shift.copy(), True)[1:]
    seen = [cv2.projectPoints(place, *pose, K, None)[0] for pose, K in (((turn, shift), right), (again, wrong))]
    expected = np.linalg.norm(seen[1] - seen[0]) / 1e3 * (T[:3, :3] @ place + T[:3, 3])[2]
    found = calibration_error(Camera(right, np.eye(4), 800, 600), T, corners, place, own)
    assert np.sqrt(np.trace(found)) == pytest.approx(expected, rel=0.1)

"""How far a place beside a target is off in the picture by the errors of the camera's calibration."""

from __future__ import annotations

import cv2
import numpy as np

from ..optics.camera import Camera

# Columns of OpenCV's derivatives: turn and shift of a pose; focal lengths, principal point and five of the lens.
POSE, INTRINSIC = slice(0, 6), slice(6, 15)


def calibration_error(
    camera: Camera, T_camera_target: np.ndarray, corners: np.ndarray, place: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """The covariance (3, 3) [m^2], in the camera's frame, of a place of a target, by that of the camera's calibration.

    The pose takes up most of an error of the calibration, for target and place are seen by the same camera. What is
    left is found by the derivatives of the projection: as far as it is seen, across the line of sight.

    Parameters
    ----------
    camera
        As it took the picture; where it stands is of no account.
    T_camera_target
        (4, 4) [m]: fitted to the corners by this camera.
    corners, place
        (n, 3) and (3,) [m] in the target's frame.
    covariance
        (9, 9) of `ar.tracking.intrinsics.PARAMETERS`.
    """
    distortion = np.pad(np.ravel(camera.distortion), (0, 5))[: max(5, np.size(camera.distortion))]
    turn = cv2.Rodrigues(T_camera_target[:3, :3])[0]
    slopes = [
        cv2.projectPoints(points, turn, T_camera_target[:3, 3], camera.K, distortion)[1]
        for points in (corners, place[None])
    ]
    seen, there = slopes
    taken_up = np.linalg.lstsq(seen[:, POSE], seen[:, INTRINSIC], rcond=None)[0]
    left = there[:, INTRINSIC] - there[:, POSE] @ taken_up
    across = np.linalg.pinv(there[:, 3:6]) @ left
    return across @ covariance @ across.T

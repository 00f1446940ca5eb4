"""Calibrations as text: what OpenCV and ROS write is read, and what is wrong is refused by name."""

import cv2
import numpy as np
import pytest
import yaml

from ar.optics.calibration import Calibration, opencv_text, ros_text
from ar.optics.calibration_text import parsed
from ar.optics.lens import Lens

SOME = Calibration((820.5, 818.25), (321.0, 236.5), 640, 480, Lens(-0.31, 0.12, 1e-3, -2e-3, -0.02), "left/1")
RATIONAL = Calibration((820.5, 818.25), (321.0, 236.5), 640, 480, Lens(-0.3, 0.1, 0, 0, 0, 0.1, 0.02, 1e-3), 'Nähe "2"')


@pytest.mark.parametrize("calibration", [SOME, RATIONAL])
@pytest.mark.parametrize("form", [opencv_text, ros_text])
def test_what_is_written_is_read_again(calibration, form):
    assert parsed(form(calibration)) == calibration


def test_opencv_reads_what_we_write():
    storage = cv2.FileStorage(opencv_text(SOME), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert np.array_equal(storage.getNode("camera_matrix").mat(), SOME.K)
    assert storage.getNode("distortion_coefficients").mat().ravel().tolist() == [-0.31, 0.12, 1e-3, -2e-3, -0.02]
    assert storage.getNode("image_width").real() == 640 and storage.getNode("camera_name").string() == "left/1"


@pytest.mark.parametrize("calibration", [SOME, RATIONAL])
def test_any_yaml_reader_reads_what_we_write_for_ros(calibration):
    found = yaml.safe_load(ros_text(calibration))
    assert found["camera_name"] == calibration.name and found["image_height"] == 480
    assert (
        found["distortion_model"]
        == {5: "plumb_bob", 8: "rational_polynomial"}[found["distortion_coefficients"]["cols"]]
    )
    assert found["distortion_coefficients"]["data"][:2] == calibration.lens.coefficients[:2].tolist()
    assert np.array_equal(np.reshape(found["camera_matrix"]["data"], (3, 3)), calibration.K)
    assert np.array_equal(np.reshape(found["projection_matrix"]["data"], (3, 4))[:, :3], calibration.K)
    assert np.array_equal(np.reshape(found["rectification_matrix"]["data"], (3, 3)), np.eye(3))


def test_pictures_of_another_size_are_scaled_only_if_asked_and_of_the_same_shape():
    with pytest.raises(ValueError, match=r"640 x 480, not 320 x 240: calibrate with that size, or ask"):
        SOME.sized(320, 240)
    with pytest.raises(ValueError, match=r"not 640 x 360, which have another shape"):
        SOME.sized(640, 360, scale=True)
    assert SOME.sized(640, 480) is SOME
    half, points = SOME.sized(320, 240, scale=True), np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0]])
    pixels = [one.camera(np.eye(4)).project(points)[0] + 0.5 for one in (half, SOME)]
    assert np.allclose(2.0 * pixels[0], pixels[1]) and half.lens == SOME.lens and half.name == SOME.name


def test_the_camera_of_a_calibration_is_opencvs():
    camera, points = SOME.camera(np.eye(4)), np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0]])
    wanted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), SOME.K, SOME.lens.coefficients[:5])[0]
    assert np.allclose(camera.project(points)[0], wanted.reshape(-1, 2), atol=1e-9)
    assert repr(SOME) == repr(parsed(ros_text(SOME)))

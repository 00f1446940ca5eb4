"""Calibration files of OpenCV and ROS: reading, writing and messages for invalid files."""

import re

import cv2
import numpy as np
import pytest
import yaml

from ar.optics.calibration import MAX_TEXT_LENGTH, Calibration, parse_calibration, to_opencv_text, to_ros_text
from ar.optics.lens import Lens

SOME = Calibration((820.5, 818.25), (321.0, 236.5), 640, 480, Lens(-0.31, 0.12, 1e-3, -2e-3, -0.02), "left/1")
RATIONAL = Calibration((820.5, 818.25), (321.0, 236.5), 640, 480, Lens(-0.3, 0.1, 0, 0, 0, 0.1, 0.02, 1e-3), 'Nähe "2"')
ROS = """# of camera_calibration_parsers
image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [520, 0, 320.5,
         0, 521.5, 240,
         0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.25, 0.05, 1e-3, -2.0e-04, 0]}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [520, 0, 320.5, 0, 0, 521.5, 240, 0, 0, 0, 1, 0]
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Thu 26 Nov 2026 09:00:00"
nframes: 20
image_width: 1280
image_height: 720
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 9.0e+02, 0., 6.395e+02, 0., 9.0e+02, 3.595e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -2.0e-01, 1.0e-01, 1.0e-03, 2.0e-03 ]
avg_reprojection_error: 2.1e-01
"""
MATRIX = "camera_matrix:\n  cols: 3\n  data:\n{}  rows: 3\n"
PLAIN = "image_width: 640\nimage_height: 480\ncamera_name: {}\n{}distortion_model: plumb_bob\n{}"
NUMBERS = [500.0, 0, 320.0, 0, 5e2, 240.0, 0, 0, 1]
LENS = "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, -0.2, 0.0, 0.0, 0.0]\n"


@pytest.mark.parametrize("calibration", [SOME, RATIONAL])
@pytest.mark.parametrize("form", [to_opencv_text, to_ros_text])
def test_written_calibration_is_read_unchanged(calibration, form):
    assert parse_calibration(form(calibration)) == calibration


def test_opencv_reads_the_written_calibration():
    storage = cv2.FileStorage(to_opencv_text(SOME), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert np.array_equal(storage.getNode("camera_matrix").mat(), SOME.K)
    assert storage.getNode("distortion_coefficients").mat().ravel().tolist() == [-0.31, 0.12, 1e-3, -2e-3, -0.02]
    assert storage.getNode("image_width").real() == 640 and storage.getNode("camera_name").string() == "left/1"


@pytest.mark.parametrize("calibration", [SOME, RATIONAL])
def test_yaml_reader_reads_the_calibration_written_for_ros(calibration):
    found = yaml.safe_load(to_ros_text(calibration))
    assert found["camera_name"] == calibration.name and found["image_height"] == 480
    assert (
        found["distortion_model"]
        == {5: "plumb_bob", 8: "rational_polynomial"}[found["distortion_coefficients"]["cols"]]
    )
    assert found["distortion_coefficients"]["data"][:2] == calibration.lens.coefficients[:2].tolist()
    assert np.array_equal(np.reshape(found["camera_matrix"]["data"], (3, 3)), calibration.K)
    assert np.array_equal(np.reshape(found["projection_matrix"]["data"], (3, 4))[:, :3], calibration.K)
    assert np.array_equal(np.reshape(found["rectification_matrix"]["data"], (3, 3)), np.eye(3))


def test_image_scaling_requires_option_and_same_aspect_ratio():
    with pytest.raises(ValueError, match=r"640 x 480, not 320 x 240: calibrate with that size, or ask"):
        SOME.resize_calibration(320, 240)
    with pytest.raises(ValueError, match=r"not 640 x 360, which have another shape"):
        SOME.resize_calibration(640, 360, allow_scaling=True)
    assert SOME.resize_calibration(640, 480) is SOME
    half, points = SOME.resize_calibration(320, 240, allow_scaling=True), np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0]])
    pixels = [one.build_camera(np.eye(4)).project(points)[0] + 0.5 for one in (half, SOME)]
    assert np.allclose(2.0 * pixels[0], pixels[1]) and half.lens == SOME.lens and half.name == SOME.name


def test_camera_of_calibration_projects_as_opencv():
    camera, points = SOME.build_camera(np.eye(4)), np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0]])
    wanted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), SOME.K, SOME.lens.coefficients[:5])[0]
    assert np.allclose(camera.project(points)[0], wanted.reshape(-1, 2), atol=1e-9)
    assert repr(SOME) == repr(parse_calibration(to_ros_text(SOME)))


def test_calibrations_of_ros_and_opencv_are_read():
    ros, opencv = parse_calibration(ROS), parse_calibration(OPENCV)
    assert ros == Calibration(
        (520, 521.5), (320.5, 240), 640, 480, Lens(-0.25, 0.05, 1e-3, -2e-4), "narrow_stereo/left"
    )
    assert opencv == Calibration((900, 900), (639.5, 359.5), 1280, 720, Lens(-0.2, 0.1, 1e-3, 2e-3))
    block = "data:\n" + "".join(f"      - {value}\n" for value in [900, 0, 639.5, 0, 900, 359.5, 0, 0, 1])
    assert parse_calibration(re.sub(r"data: \[ 9.*\]\n", block, OPENCV)) == opencv
    assert parse_calibration("\ufeff---\n" + ROS.replace("\n", "\r\n")) == ros
    assert parse_calibration(ROS.replace("narrow_stereo/left", "17")).name == "17"
    twelve = OPENCV.replace("rows: 4", "rows: 12").replace("2.0e-03 ]", "2.0e-03, 0, 0.1, 0.01, 0, 0, 0, 0, 0 ]")
    assert parse_calibration(twelve).lens == Lens(-0.2, 0.1, 1e-3, 2e-3, 0.0, 0.1, 0.01)


def changed(old, new, text=ROS):
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "reason"),
    {
        "empty": ("", "image_width is missing"),
        "words": ("a camera", "no YAML|missing"),
        "xml": ("<?xml version='1.0'?><opencv_storage/>", "no YAML"),
        "no camera": (changed("camera_matrix", "matrix"), "camera_matrix is missing"),
        "no lens": (changed("distortion_coefficients", "d"), "distortion_coefficients is missing; five times 0"),
        "twice": (ROS + "image_width: 3\n", "image_width is given twice"),
        "not a number": (changed("520", ".nan"), "camera_matrix holds a number that is not finite"),
        "infinite": (changed("-0.25", ".Inf"), "distortion_coefficients holds a number that is not finite"),
        "text": (changed("520", "wide"), "camera_matrix holds what is no number"),
        "focal": (changed("520", "-520"), "focal lengths are numbers of pixels above 0"),
        "no focal": (changed("520", "0"), "focal lengths"),
        "skew": (changed("520, 0,", "520, 3,"), "without skew"),
        "shape": (changed("rows: 3", "rows: 4"), "camera_matrix says 4 x 3, which must be 3 x 3, and has 9"),
        "huge": (changed("rows: 3", "rows: 2000000000"), "camera_matrix says 2000000000 x 3"),
        "less": (changed("rows: 3", "rows: -3"), "camera_matrix says -3 x 3"),
        "short": (changed("0, 0, 1]", "0, 1]"), "camera_matrix says 3 x 3, which must be 3 x 3, and has 8"),
        "rectification": (changed("[1, 0, 0, 0, 1, 0, 0, 0, 1]", "[1]"), "rectification_matrix says 3 x 3"),
        "projection": (changed("240, 0, 0, 0, 1, 0]", "240]"), "projection_matrix says 3 x 4"),
        "model": (changed("plumb_bob", "equidistant"), "'equidistant' is not known: choose one of plumb_bob"),
        "no model": (changed("plumb_bob", "[1]"), "distortion_model '' is not known"),
        "few": (changed("plumb_bob", "rational_polynomial"), "rational_polynomial has 8 coefficients, not 5"),
        "fisheye": (changed("fisheye_model: 0", "fisheye_model: 1", OPENCV), "without CALIB_FISHEYE"),
        "three": (changed("cols: 5, data: [-0.25, 0.05,", "cols: 3, data: ["), "has 3 numbers"),
        "prism": (
            changed("cols: 5, data: [", "cols: 12, data: [1, 2, 3, 4, 5, 6, 7, ").replace(
                "plumb_bob", "rational_polynomial"
            ),
            "thin prism",
        ),
        "width": (changed("640", "0"), "image_width of 1 to"),
        "wide": (changed("640", "1000000"), "image_width of 1 to"),
        "part of a pixel": (changed("640", "640.5"), "image_width must be a whole number"),
        "other size": (changed("640", "100"), "principal point .* far outside an image of 100 x 480"),
        "name": (changed("narrow_stereo/left", "[1]"), "camera_name must be text"),
        "long name": (changed("narrow_stereo/left", "x" * 300), "at most 256 characters"),
        "long": (ROS + "#" * MAX_TEXT_LENGTH, "more than"),
        "deep": ("a: " + "[" * 30000 + "]" * 30000, "nested too deeply"),
        "deep maps": ("a: " + "{a: " * 9000, "nested too deeply"),
        "deep lists": ("a: " + "- " * 30000, "nested too deeply"),
        "deep list": ("a:\n" + " - " * 20000, "nested too deeply"),
        "control": (ROS + "\0", "no YAML"),
        "tabs": (changed("  rows", "\trows"), "no YAML that OpenCV reads|must have rows"),
        "list": ("- 1\n- 2\n", "missing"),
    }.values(),
)
def test_invalid_calibration_is_rejected_with_remedy(text, reason):
    with pytest.raises(ValueError, match=reason) as refused:
        parse_calibration(text)
    assert re.search(r"[.:;] .+", str(refused.value)) and len(str(refused.value)) < 400


def test_damaged_calibration_raises_only_value_error():
    """Truncated text or replaced characters give a ValueError or a finite calibration."""
    random, signs = np.random.default_rng(0), list("\n\t :-[]{}\"'#&*!|>%@0.9eé\\")
    for text in (ROS, OPENCV, to_opencv_text(RATIONAL)):
        damaged = [text[:cut] for cut in range(0, len(text), 7)]
        for _ in range(300):
            letters = list(text)
            for at in random.integers(0, len(letters), 3):
                letters[at] = signs[random.integers(len(signs))]
            damaged.append("".join(letters))
        for each in damaged:
            try:
                assert np.isfinite(parse_calibration(each).K).all()
            except ValueError as error:
                assert str(error)


@pytest.mark.parametrize("inset", ["  ", "    "])
@pytest.mark.parametrize("name", ["720p", "4k_cam", "2024-01-02", "left: 1", "12", '"quoted"'])
def test_ros_calibration_with_unquoted_names_is_read(name, inset):
    lists = MATRIX.format("".join(f"{inset}- {number}\n" for number in NUMBERS))
    for start in ("", "\ufeff", "%YAML:1.0\n---\n", "stamp: 12:30:01\nnote: 3rd\n"):
        found = parse_calibration(start + PLAIN.format(name, lists, LENS))
        assert found.name == name.strip('"') and found.focal == (500.0, 500.0) and found.lens.k1 == 0.1


def test_calibration_with_zero_matrix_is_rejected():
    lists = MATRIX.format("  - 0.0\n" * 9)
    with pytest.raises(ValueError, match="a camera that is not calibrated: calibrate it first"):
        parse_calibration(PLAIN.format("cam", lists, LENS))

"""The pinhole model: against OpenCV, and against what a picture must do."""

import numpy as np
import pytest

from ar.optics.camera import Camera, look_at, project_cv2

EYE, TARGET, UP = np.array([0.1, -0.3, 0.2]), np.array([0.02, 0.01, 0.05]), np.array([0.0, 0.0, 1.0])


def some_camera() -> Camera:
    return look_at(EYE, TARGET, UP, np.radians(30.0), 320, 200)


def points_in_front(count: int = 200) -> np.ndarray:
    return TARGET + 0.05 * np.random.default_rng(0).standard_normal((count, 3))


def test_projection_is_opencvs():
    camera = some_camera()
    skewed = Camera(camera.K + [[0, 3.0, 7.5], [0, 12.0, -4.0], [0, 0, 0]], camera.T_camera_world, 320, 200)
    for one in (camera, camera.perturbed(3.0, (1.0, 2.0, -1.0))):
        pixels, _ = one.project(points_in_front())
        assert np.abs(pixels - project_cv2(one, points_in_front())).max() < 1e-9
    # OpenCV has no skew, so a skewed camera must be noticed by the comparison.
    assert np.abs(skewed.project(points_in_front())[0] - project_cv2(skewed, points_in_front())).max() > 0.1


def test_target_is_in_the_middle_right_is_right_and_up_is_up():
    camera = some_camera()
    pixel, depth = camera.project(TARGET)
    assert pixel == pytest.approx([159.5, 99.5])
    assert depth == pytest.approx(np.linalg.norm(TARGET - EYE))
    above, _ = camera.project(TARGET + 0.01 * UP)
    right, _ = camera.project(TARGET + 0.01 * np.cross(TARGET - EYE, UP))
    assert above[1] < pixel[1] and right[0] > pixel[0]
    assert camera.centre == pytest.approx(EYE)
    assert camera.vertical_fov == pytest.approx(np.radians(30.0))


def test_unproject_inverts_project():
    camera, points = some_camera(), points_in_front()
    assert np.allclose(camera.unproject(*camera.project(points)), points, atol=1e-12)


def test_points_behind_have_no_pixel():
    pixels, depth = some_camera().project(np.array([EYE - (TARGET - EYE), TARGET]))
    assert np.isnan(pixels[0]).all() and depth[0] < 0.0 and np.isfinite(pixels[1]).all()


def test_half_a_degree_moves_the_picture_by_half_a_degree():
    camera = some_camera()
    moved, _ = camera.perturbed(0.5).project(TARGET)
    assert moved - [159.5, 99.5] == pytest.approx([camera.K[0, 0] * np.tan(np.radians(0.5)), 0.0], abs=1e-9)
    assert camera.perturbed(0.5).centre == pytest.approx(EYE)


@pytest.mark.parametrize("aspect", [2.5, 1.6, 1.0, 0.45])
def test_padding_centres_the_picture_on_a_canvas_of_any_shape(aspect):
    camera = some_camera()
    canvas = camera.padded(aspect)
    assert canvas.width / canvas.height == pytest.approx(aspect, rel=0.01)
    assert canvas.width >= camera.width and canvas.height >= camera.height
    shift = canvas.project(points_in_front())[0] - camera.project(points_in_front())[0]
    assert np.allclose(shift, [(canvas.width - camera.width) // 2, (canvas.height - camera.height) // 2])


def test_twice_the_pixels_see_the_same_view():
    camera = some_camera()
    double = camera.scaled(2.0)
    assert (double.width, double.height) == (640, 400)
    assert np.allclose(double.project(points_in_front())[0] + 0.5, 2.0 * (camera.project(points_in_front())[0] + 0.5))


def test_the_camera_of_a_part_of_the_picture_sees_that_part():
    camera = some_camera()
    part = camera.cropped(slice(20, 150), slice(30, 290))
    assert (part.width, part.height) == (260, 130)
    assert np.allclose(part.project(points_in_front())[0] + [30, 20], camera.project(points_in_front())[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"K": np.eye(4)}, "K"),
        ({"K": np.diag([-1.0, 1.0, 1.0])}, "focal"),
        ({"T_camera_world": 2.0 * np.eye(4)}, "rotation"),
        ({"T_camera_world": np.diag([1.0, 1.0, -1.0, 1.0])}, "rotation"),
        ({"width": 0}, "empty"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, reason):
    good = {"K": np.diag([100.0, 100.0, 1.0]), "T_camera_world": np.eye(4), "width": 4, "height": 3}
    with pytest.raises(ValueError, match=reason):
        Camera(**(good | change))


def test_a_view_without_direction_is_refused():
    with pytest.raises(ValueError, match="undefined"):
        look_at(EYE, EYE, UP)
    with pytest.raises(ValueError, match="undefined"):
        look_at(EYE, EYE + UP, UP)

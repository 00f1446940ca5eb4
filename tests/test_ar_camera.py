"""Pinhole camera model compared with OpenCV, and rolling-shutter images."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from test_ar_lens import SOME, scene, seen_by
from test_ar_renderer import LAMP
from theatres import template_theatre

from ar.optics.calibration import parse_calibration, to_opencv_text, to_ros_text
from ar.optics.camera import (
    BASELINE,
    Camera,
    build_stereo_pair,
    compute_row_time,
    find_row_time,
    look_at,
    project_cv2,
    split_row_bands,
)
from ar.rendering.layer import Layer
from ar.rendering.renderer import Lamp, Renderer, render
from scenes.play.player import Player
from scenes.script.camera_paths import HandHeld
from scenes.script.scene import find_scene
from scenes.tracked.filming import USUAL_CALIBRATION, VIEW, Artefacts, mount_targets, register_with_error, render_frames
from scenes.tracked.follower import Follower, TumourState
from scenes.tracked.tool_motion import ToolMotion
from sim.anatomy import Anatomy
from surrogate.model.learned import build_prediction

EYE, TARGET, UP = np.array([0.1, -0.3, 0.2]), np.array([0.02, 0.01, 0.05]), np.array([0.0, 0.0, 1.0])
CAMERA = look_at(np.array([0.0, 0.0, -0.4]), np.zeros(3), np.array([0.0, -1.0, 0.0]), np.radians(16.0), 400, 300)
READOUT = 0.03
HAND = HandHeld(seed=3, turn=float(np.radians(0.5)))
GRID = np.array([[x, y, 0.0] for x in (-0.05, 0.0, 0.05) for y in (-0.04, -0.02, 0.0, 0.02, 0.04)])


def some_camera() -> Camera:
    return look_at(EYE, TARGET, UP, np.radians(30.0), 320, 200)


def points_in_front(count: int = 200) -> np.ndarray:
    return TARGET + 0.05 * np.random.default_rng(0).standard_normal((count, 3))


def test_projection_equals_opencv_projection():
    camera = some_camera()
    skewed = Camera(camera.K + [[0, 3.0, 7.5], [0, 12.0, -4.0], [0, 0, 0]], camera.T_camera_world, 320, 200)
    for one in (camera, camera.perturb(3.0, (1.0, 2.0, -1.0))):
        pixels, _ = one.project(points_in_front())
        assert np.abs(pixels - project_cv2(one, points_in_front())).max() < 1e-9
    # OpenCV has no skew, so a skewed camera must be noticed by the comparison.
    assert np.abs(skewed.project(points_in_front())[0] - project_cv2(skewed, points_in_front())).max() > 0.1


def test_look_at_centres_target_with_right_and_up_axes():
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


def test_points_behind_the_camera_project_to_nan():
    pixels, depth = some_camera().project(np.array([EYE - (TARGET - EYE), TARGET]))
    assert np.isnan(pixels[0]).all() and depth[0] < 0.0 and np.isfinite(pixels[1]).all()


def test_perturbation_of_half_a_degree_shifts_the_target():
    camera = some_camera()
    moved, _ = camera.perturb(0.5).project(TARGET)
    assert moved - [159.5, 99.5] == pytest.approx([camera.K[0, 0] * np.tan(np.radians(0.5)), 0.0], abs=1e-9)
    assert camera.perturb(0.5).centre == pytest.approx(EYE)


@pytest.mark.parametrize("aspect", [2.5, 1.6, 1.0, 0.45])
def test_padding_centres_the_image_at_any_aspect_ratio(aspect):
    camera = some_camera()
    canvas = camera.pad(aspect)
    assert canvas.width / canvas.height == pytest.approx(aspect, rel=0.01)
    assert canvas.width >= camera.width and canvas.height >= camera.height
    shift = canvas.project(points_in_front())[0] - camera.project(points_in_front())[0]
    assert np.allclose(shift, [(canvas.width - camera.width) // 2, (canvas.height - camera.height) // 2])


def test_scaled_camera_has_the_same_view():
    camera = some_camera()
    double = camera.scale(2.0)
    assert (double.width, double.height) == (640, 400)
    assert np.allclose(double.project(points_in_front())[0] + 0.5, 2.0 * (camera.project(points_in_front())[0] + 0.5))


def test_cropped_camera_shifts_pixels_by_the_crop_origin():
    camera = some_camera()
    part = camera.crop_to(slice(20, 150), slice(30, 290))
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
def test_invalid_camera_parameters_are_rejected(change, reason):
    good = {"K": np.diag([100.0, 100.0, 1.0]), "T_camera_world": np.eye(4), "width": 4, "height": 3}
    with pytest.raises(ValueError, match=reason):
        Camera(**(good | change))


def test_look_at_rejects_undefined_view_direction():
    with pytest.raises(ValueError, match="undefined"):
        look_at(EYE, EYE, UP)
    with pytest.raises(ValueError, match="undefined"):
        look_at(EYE, EYE + UP, UP)


def near_points() -> np.ndarray:
    """In view of every camera here."""
    return 0.3 * points_in_front()


def test_camera_moves_along_its_own_axes():
    camera, shift = some_camera(), np.array([0.01, -0.02, 0.03])
    moved = camera.move(shift)
    assert np.allclose(moved.to_camera_frame(points_in_front()), camera.to_camera_frame(points_in_front()) - shift)
    assert moved.centre == pytest.approx(EYE + shift @ camera.T_camera_world[:3, :3])


def test_zoom_magnifies_about_the_principal_point():
    for camera in (some_camera(), seen_by()):
        middle = camera.K[:2, 2]
        near = camera.zoom(2.0)
        ways = [one.project(near_points())[0] - middle for one in (camera, near)]
        assert np.allclose(ways[1], 2.0 * ways[0])
        assert np.abs(project_cv2(near, near_points()) - near.project(near_points())[0]).max() < 1e-8
    for factor in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="above 0"):
            some_camera().zoom(factor)


def test_refocus_scales_focal_length_by_thin_lens_equation():
    """1 / f = 1 / d + 1 / b; the size of the image is proportional to b."""
    camera = some_camera()
    for d in (0.2, 0.3, 1e9):
        b = 1.0 / (1.0 / 50e-3 - 1.0 / d)
        start = 1.0 / (1.0 / 50e-3 - 1.0 / 0.25)
        assert camera.refocus(50e-3, 0.25, d).K[0, 0] == pytest.approx(camera.K[0, 0] * b / start)
    for wrong in ((50e-3, 0.25, 0.04), (0.0, 0.25, 0.3), (50e-3, np.nan, 0.3), (50e-3, 0.05, 0.3)):
        with pytest.raises(ValueError, match="focus farther"):
            camera.refocus(*wrong)


def test_parallel_stereo_pair_has_rows_equal_and_disparity():
    camera = some_camera()
    left, right = build_stereo_pair(camera)
    assert np.linalg.norm(left.centre - right.centre) == pytest.approx(BASELINE) == pytest.approx(24e-3)
    (u, depth), (v, _) = (one.project(points_in_front()) for one in (left, right))
    assert np.allclose(u[:, 1], v[:, 1])
    assert np.allclose(u[:, 0] - v[:, 0], camera.K[0, 0] * BASELINE / depth)


def test_converging_stereo_axes_meet_at_working_distance():
    camera = some_camera()
    distance = float(np.linalg.norm(TARGET - EYE))
    left, right = build_stereo_pair(camera, 30e-3, distance)
    for one in (left, right):
        assert one.project(TARGET)[0] == pytest.approx([159.5, 99.5], abs=1e-9)
    assert left.to_camera_frame(right.centre)[0] > 0.0 and np.linalg.norm(left.centre - right.centre) == pytest.approx(
        30e-3
    )
    assert left.T_camera_world[2, :3] @ right.T_camera_world[2, :3] == pytest.approx(
        np.cos(2.0 * np.arctan(15e-3 / distance))
    )


def test_points_are_triangulated_from_distorted_stereo_images():
    """Undistorted and triangulated with OpenCV."""
    for pair in (build_stereo_pair(seen_by(SOME)), build_stereo_pair(seen_by(SOME), working_distance=0.14)):
        seen = []
        for one in pair:
            pixels = np.ascontiguousarray(one.project(near_points()[:50])[0])[:, None]
            seen.append(cv2.undistortPoints(pixels, one.K, SOME.coefficients).reshape(-1, 2).T)
        found = cv2.triangulatePoints(*(one.T_camera_world[:3] for one in pair), *seen)
        assert np.abs((found[:3] / found[3]).T - near_points()[:50]).max() < 1e-4
    pictures = [render(one, scene(), LAMP).colour for one in build_stereo_pair(seen_by(SOME))]
    assert (pictures[0] != pictures[1]).mean() > 0.1


def test_invalid_stereo_baseline_or_distance_is_rejected():
    for wrong in ((0.0, None), (np.nan, None), (24e-3, 0.0), (24e-3, -1.0)):
        with pytest.raises(ValueError, match="above 0"):
            build_stereo_pair(some_camera(), *wrong)


@dataclass(frozen=True)
class Still:
    """A brain that is known not to move."""

    anatomy: Anatomy

    def deform(self, loads, start=None, at=None):
        every = np.arange(len(self.anatomy.mesh.nodes))
        none = np.full((2, len(loads)), np.nan)
        return build_prediction(
            np.zeros((len(loads), len(every), 3)), every, loads, [False] * len(loads), 0.0, none, ""
        )


def camera_at(after):
    return HAND(CAMERA, np.zeros(3), 1.0 + after)


def discs(radius=3e-3, corners=48):
    """Small discs about the places of a grid, of which each has its own id."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    ends = np.arange(corners)
    triangles = np.column_stack([0 * ends, 1 + ends, 1 + np.roll(ends, -1)])
    return [Layer(str(n), n + 1, place + np.vstack([np.zeros(3), rim]), triangles) for n, place in enumerate(GRID)]


def test_image_rows_use_camera_pose_at_their_readout_time():
    layers = discs()
    renderer = Renderer(layers, Lamp(np.array([0.0, 0.0, -0.4]), np.zeros(3), 0.2))
    bands = split_row_bands(camera_at, READOUT, GRID)
    vertices = [layer.vertices for layer in layers]
    drawn = np.concatenate([renderer.render(camera, vertices).segmentation for _, camera in bands])
    assert drawn.shape == (300, 400) and len(bands) > 5
    still = CAMERA.project(GRID)[0]
    apart = []
    for number, place in enumerate(GRID):
        middle = np.argwhere(drawn == number + 1).mean(axis=0)[::-1]
        # By single rows: the row in which the place is seen is that which has the camera there.
        row = still[number, 1]
        for _ in range(20):
            pixel = camera_at(READOUT * (row / 299.0 - 0.5)).project(place[None])[0][0]
            row = pixel[1]
        apart.append(np.linalg.norm(middle - pixel))
        assert np.linalg.norm(camera_at(0.0).project(place[None])[0][0] - pixel) < 20.0
        assert find_row_time(camera_at, READOUT, place) == pytest.approx(compute_row_time(row, 300, READOUT), abs=1e-6)
    assert max(apart) < 0.3
    moved = [np.linalg.norm(camera_at(0.0).project(place[None])[0][0] - still[n]) for n, place in enumerate(GRID)]
    assert max(moved) > 1.0  # the test would see a shutter that does not roll


def test_fixed_camera_has_one_row_band():
    ((rows, camera),) = split_row_bands(lambda after: CAMERA, READOUT, GRID)
    assert rows == slice(0, 300) and (camera.width, camera.height) == (400, 300)
    np.testing.assert_allclose(compute_row_time(np.array([-5, 0, 299, 400]), 300, 0.03), [-0.015, -0.015, 0.015, 0.015])
    assert find_row_time(camera_at, READOUT, np.array([0.0, 0.0, -1.0])) == 0.0  # behind it


def test_calibration_files_store_the_readout_time():
    for text in (to_opencv_text, to_ros_text):
        assert parse_calibration(text(replace(USUAL_CALIBRATION, readout=0.0125))).readout == 0.0125
        assert "readout" not in text(USUAL_CALIBRATION) and parse_calibration(text(USUAL_CALIBRATION)).readout == 0.0
        with pytest.raises(ValueError, match="readout_time must be a number"):
            parse_calibration(text(USUAL_CALIBRATION) + 'readout_time: "fast"\n')
        with pytest.raises(ValueError, match="read in 0 to 1 s"):
            parse_calibration(text(USUAL_CALIBRATION) + "readout_time: -1\n")
    assert replace(USUAL_CALIBRATION, readout=0.02).resize_calibration(640, 480, allow_scaling=True).readout == 0.02


@pytest.fixture(scope="module")
def player():
    theatre = template_theatre()
    small = replace(USUAL_CALIBRATION.resize_calibration(800, 600, allow_scaling=True), readout=READOUT)
    view = replace(VIEW.calibrate(small), path=HandHeld(0))
    return Player(
        theatre.build_stage(replace(find_scene("palpate"), viewpoint=view, duration=0.1)), Still(theatre.anatomy)
    )


def test_rolling_shutter_increases_tracking_error_on_video(player):
    mounts = mount_targets(player)
    shots = list(render_frames(player, mounts, Artefacts(noise=0.0)))
    calibration = player.scene.viewpoint.calibration
    assert calibration is not None
    still = replace(player.scene.viewpoint, calibration=replace(calibration, readout=0.0))
    other = replace(player, stage=replace(player.stage, scene=replace(player.scene, viewpoint=still)))
    plain = next(iter(render_frames(other, mounts, Artefacts(noise=0.0))))
    rows = np.abs(plain.image.astype(int) - shots[0].image).mean(axis=(1, 2))
    assert rows[290:310].mean() < 0.4 * max(rows[:100].mean(), rows[500:].mean())  # the middle row has its time
    follower = Follower(
        calibration,
        register_with_error(player.site, mounts, 0.0, 0.0, 0),
        mounts.tool,
        ToolMotion(player.stage, player.deformer),
    )
    known, all_known = None, []
    for shot in shots:
        known = follower.track(cv2.cvtColor(shot.image, cv2.COLOR_RGB2GRAY), shot.time, known)
        all_known.append(known)
    # How the camera moves is not known from one picture.
    assert all_known[0].state is TumourState.UNSURE and "rolling shutter" in all_known[0].warning
    assert all(each.is_reliable and each.sources["shutter"] > 0.0 for each in all_known[1:])
    at_once = replace(follower, calibration=replace(calibration, readout=0.0))
    alike = at_once.track(cv2.cvtColor(shots[1].image, cv2.COLOR_RGB2GRAY), shots[1].time)
    assert alike.is_reliable and "shutter" not in alike.sources
    assert all_known[1].bound > 1.5 * alike.bound
    # A hand that was fast a moment ago may be again.
    assert all_known[-1].image_speed >= 0.5 * max(each.image_speed for each in all_known[1:])

"""Cameras of scenes: calibrated, moved, zoomed, focused; and the overlay in register under each, by OpenCV alone."""

from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
from theatres import player, put, small

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera, project_cv2
from ar.optics.lens import Lens
from ar.overlay.outlines import iou, silhouette
from ar.screen import read_png
from scenes.cli import main
from scenes.options.camera_options import PATHS as NAMES
from scenes.play.checks import measure
from scenes.play.picture_checks import drawn_off
from scenes.play.reference import truth_of
from scenes.script.camera_paths import PATHS, Focus, HandHeld, Microscope, Orbit, wandering
from scenes.script.scene import Bounds
from scenes.script.site import site_of
from scenes.script.tool_paths import press
from scenes.script.viewpoint import USUAL, Viewpoint
from scenes.tracked.calibration_file import write_calibration
from sim.errors import InputError

LENS = Lens(-4.0, 6.0, 0.02, -0.015, 0.0)
REAL = Calibration((1750.0, 1740.0), (250.0, 170.0), 480, 360, LENS, "theatre")
TIMES = np.linspace(0.0, 4.0, 41)


@pytest.fixture(scope="module")
def site(box):
    return site_of(box)


def filmed(theatre, name="fem", **view):
    scene = small(path=press(0.2, hold=0.5))
    return player(theatre, replace(scene, viewpoint=replace(scene.viewpoint.calibrated(REAL), **view)), name)


@pytest.mark.parametrize("name", PATHS)
def test_a_path_is_a_pure_function_that_keeps_the_site_in_the_picture(site, name):
    view = replace(USUAL, path=PATHS[name](3))
    cameras = [view.camera(site, float(time)) for time in TIMES]
    again = [view.camera(site, float(time)) for time in TIMES[::-1]][::-1]
    for one, other in zip(cameras, again, strict=True):
        assert np.array_equal(one.T_camera_world, other.T_camera_world) and np.array_equal(one.K, other.K)
        at, depth = one.project(view.target(site))
        assert depth > 0.1 and np.abs(at - [319.5, 239.5]).max() < 100
    assert np.ptp([one.project(site.origin)[0] for one in cameras], axis=0).max() > 2.0


def test_the_same_hand_moves_in_the_same_way_and_another_does_not(site):
    one, same, other = (replace(USUAL, path=HandHeld(seed)).camera(site, 1.7) for seed in (5, 5, 6))
    assert np.array_equal(one.T_camera_world, same.T_camera_world)
    assert np.abs(one.T_camera_world - other.T_camera_world).max() > 1e-5
    assert PATHS["hand-held"](5) == HandHeld(5)


def test_a_hand_moves_as_far_as_it_says_and_breathes(site):
    ways = np.array([wandering(seed, time) for seed in range(6) for time in np.arange(0.0, 60.0, 0.05)])
    assert ways.std(axis=0) == pytest.approx(np.ones(6), rel=0.15) and np.abs(ways.mean(axis=0)).max() < 0.1
    calm = replace(USUAL, path=HandHeld(0, shift=0.0, turn=0.0, breath=2e-3))
    start, top, back, low = (calm.camera(site, time).centre for time in (0.0, 1.0, 2.0, 3.0))
    assert np.linalg.norm(top - start) == pytest.approx(2e-3) and np.allclose(back, start)
    assert np.allclose(low - start, start - top)


def test_an_orbit_looks_at_its_target_from_as_far(site):
    view = replace(USUAL, path=Orbit(np.radians(25.0), 2.0))
    target, still = USUAL.target(site), USUAL.camera(site)
    for time in TIMES:
        camera = view.camera(site, float(time))
        assert camera.project(target)[0] == pytest.approx(still.project(target)[0], abs=1e-6)
        assert np.linalg.norm(camera.centre - target) == pytest.approx(0.2)
    side = view.camera(site, 0.5).centre
    ways = [(at - target) / 0.2 for at in (side, still.centre)]
    assert np.degrees(np.arccos(ways[0] @ ways[1])) == pytest.approx(25.0)


def test_a_microscope_moves_along_its_axis_zooms_and_focuses(site):
    view = replace(USUAL, path=Microscope())
    start, zoomed, far = (view.camera(site, time) for time in (0.0, 1.5, 2.8))
    target = USUAL.target(site)
    assert np.array_equal(start.K, USUAL.camera(site).K) and zoomed.K[0, 0] == pytest.approx(1.6 * start.K[0, 0])
    assert far.in_frame(target)[2] == pytest.approx(1.25 * 0.2)
    # Image distances f d / (d - f) at 250 and at 200 mm.
    assert far.K[0, 0] / start.K[0, 0] == pytest.approx((250 / 220) / (200 / 170))
    assert far.in_frame(target)[:2] == pytest.approx(start.in_frame(target)[:2], abs=1e-12)


def test_eyes_of_a_microscope_meet_at_the_site(site):
    left, right = (replace(USUAL, eye=eye).camera(site) for eye in ("left", "right"))
    for one in (left, right):
        assert one.project(USUAL.target(site))[0] == pytest.approx([319.5, 239.5])
    assert left.in_frame(right.centre)[0] > 0.023
    with pytest.raises(InputError, match="choose left or right"):
        Viewpoint(eye="third")  # type: ignore[arg-type]


def test_a_calibration_of_another_size_is_refused():
    with pytest.raises(InputError, match="480 x 360, not 640 x 480: calibrate with that size, or ask"):
        Viewpoint(calibration=REAL)
    view = Viewpoint().calibrated(REAL)
    assert (view.width, view.height) == (480, 360)


def by_opencv(camera, points):
    """Pixels of points by `cv2.projectPoints`, the coefficients taken from the calibration and not from the camera."""
    coefficients = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3])
    rotation = cv2.Rodrigues(camera.T_camera_world[:3, :3])[0]
    return cv2.projectPoints(points, rotation, camera.T_camera_world[:3, 3], camera.K, coefficients)[0].reshape(-1, 2)


def drawn_by_opencv(camera, layer, fine=8, times=4):
    """Pixels (H, W) bool inside a surface, its triangles cut into small ones, and projected and filled by OpenCV."""
    share = np.arange(fine + 1) / fine
    i, j = np.meshgrid(share, share, indexing="ij")
    weights = np.stack([1.0 - i, i * (1.0 - j), i * j], axis=-1)
    corners = np.einsum("ijk,fkx->fijx", weights, layer.vertices[layer.triangles])
    pixels = by_opencv(camera, corners.reshape(-1, 3)).reshape(corners.shape[:-1] + (2,))
    cells = np.stack([pixels[:, :-1, :-1], pixels[:, 1:, :-1], pixels[:, 1:, 1:], pixels[:, :-1, 1:]], axis=3)
    canvas = np.zeros((times * camera.height, times * camera.width), np.uint8)
    for cell in np.rint(16.0 * (times * (cells.reshape(-1, 4, 2) + 0.5) - 0.5)).astype(np.int32):
        cv2.fillConvexPoly(canvas, cell, 1, shift=4)
    return cv2.resize(canvas.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA) > 0.5


@pytest.mark.parametrize("path", [None, *PATHS])
def test_the_overlay_is_in_register_under_each_path(theatre, path):
    """The outline found again in the picture, against the tumour as OpenCV projects it."""
    play = filmed(theatre, path=None if path is None else PATHS[path](1))
    frames = list(play.frames(every=25))
    assert len({id(frame.camera) for frame in frames}) == (1 if path is None else len(frames))
    for frame in frames:
        tumour = play.stage.tumour(play.believed(frame))
        mask, ours = drawn_by_opencv(frame.camera, tumour), silhouette(frame.camera, tumour.vertices, tumour.triangles)
        middles = [np.argwhere(each).mean(axis=0) for each in (mask, ours)]
        assert mask.sum() > 5000 and np.abs(middles[0] - middles[1]).max() < 0.1 and iou(mask, ours) > 0.985
        assert drawn_off(frame, mask) < 1.5
        assert drawn_off(frame, np.roll(mask, (4, 4), axis=(0, 1))) > 1.7
        straight = project_cv2(replace(frame.camera, lens=None), tumour.vertices)
        assert np.abs(straight - by_opencv(frame.camera, tumour.vertices)).max() > 3.0


@pytest.mark.parametrize("path", PATHS)
def test_a_scene_passes_its_checks_under_each_path_and_not_another_camera(theatre, path):
    play = filmed(theatre, path=PATHS[path](1), eye="left")
    frames = list(play.frames(every=30))
    truth = truth_of(theatre, play.scene, [frame.loads for frame in frames])
    figures = measure(play, play.camera_at, frames, truth)
    assert not figures.broken(Bounds()) and figures.pixels < 1e-6
    assert measure(play, lambda time: play.camera_at(time + 0.3), frames, truth).broken(Bounds())
    assert measure(play, lambda time: replace(play.camera_at(time), lens=None), frames, truth).broken(Bounds())


def test_a_path_that_cannot_be_is_refused():
    for wrong in (
        lambda: HandHeld(-1),
        lambda: Orbit(period=0.0),
        lambda: Microscope(takes=0.0),
        lambda: Microscope((Focus(2.0, 1.0, 1.0), Focus(1.0, 1.0, 1.0))),
        lambda: Microscope((Focus(0.0, 0.0, 1.0),)),
    ):
        with pytest.raises(InputError, match="give"):
            wrong()


def test_names_on_the_command_line_are_those_of_paths():
    assert tuple(PATHS) == NAMES


def test_a_calibrated_camera_renders_checks_and_collects(theatre, tmp_path, capsys):
    path, out, body = tmp_path / "camera.yaml", tmp_path / "frames", put(theatre, tmp_path / "box.vtu")
    write_calibration(path, REAL, "ros")
    seen = ["--camera", str(path), "--path", "microscope", "--eye", "right", "--device", "cpu", "--anatomy", str(body)]
    assert main(["render", "press", "--out", str(out), "--every", "60", "--plain", *seen]) == 0
    pictures = sorted(out.iterdir())
    assert len(pictures) == 3 and read_png(pictures[0]).shape == (360, 480, 3)
    # Another camera's frames are another run's.
    assert main(["render", "press", "--out", str(out), "--every", "60", "--plain", *seen, "--size", "240x180"]) == 2
    assert main(["check", "press", "--every", "60", "--json", *seen]) == 0
    capsys.readouterr()
    for words, reason in (
        (["--size", "240x180"], "give both, or neither"),
        (["--camera", str(path), "--size", "240x240"], "another shape"),
        (["--camera", str(out)], "is no file"),
        (["--path", "hand-held", "--path-seed", "-1"], "not below 0"),
    ):
        assert main(["render", "press", "--out", str(tmp_path / "none"), *words]) == 2
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_episodes_hold_the_lens_and_the_camera_of_each_frame(theatre, tmp_path):
    from scenes.episodes.episode import collect

    play = filmed(theatre, path=Microscope((Focus(0.0, 1.2, 1.5),), 0.2))
    play = player(theatre, replace(play.scene, duration=0.2), "fem")
    collect(tmp_path / "episode.h5", theatre, play, "fem", lambda frames: frames)
    with h5py.File(tmp_path / "episode.h5") as file:
        last = play.camera_at(float(play.scene.times[-1]))
        assert np.array_equal(file["K"][:], play.camera.K) and np.array_equal(file["K_of_frame"][-1], last.K)
        assert not np.array_equal(file["K"][:], last.K) and file["distortion"][:].tolist() == LENS.coefficients.tolist()
        assert np.array_equal(file["T_camera_world"][-1], last.T_camera_world)
        positions = play.site.anatomy.mesh.nodes.copy()
        positions[file["tumour_nodes"][:]] = file["tumour_predicted"][-1]
        camera = Camera(file["K_of_frame"][-1], file["T_camera_world"][-1], file.attrs["width"], file.attrs["height"])
        mask = cv2.imdecode(file["pictures/tumour_mask"][-1], cv2.IMREAD_GRAYSCALE) > 0
        assert mask.sum() > 5000 and iou(mask, drawn_by_opencv(camera, play.stage.tumour(positions))) > 0.985

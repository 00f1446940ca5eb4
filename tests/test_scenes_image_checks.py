"""Overlay registration on each camera path and in episodes, checked by OpenCV alone."""

from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
from theatres import LENS, REAL, player, small

from ar.optics.camera import Camera, project_cv2
from ar.overlay.outlines import compute_iou, compute_silhouette
from scenes.play.checks import measure_frames
from scenes.play.image_checks import measure_outline_error
from scenes.play.reference import solve_reference_frames
from scenes.script.camera_paths import PATHS, Focus, Microscope
from scenes.script.scene import Bounds
from scenes.script.tool_paths import press
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT


def filmed(theatre, name="fem", **view):
    scene = small(path=press(0.2, hold=0.5))
    return player(theatre, replace(scene, viewpoint=replace(OBLIQUE_VIEWPOINT.calibrate(REAL), **view)), name)


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
def test_overlay_matches_opencv_projection_on_each_camera_path(theatre, path):
    """Outline found in the image, against the tumour projected by OpenCV."""
    play = filmed(theatre, path=None if path is None else PATHS[path](1))
    frames = list(play.play_frames(every=25))
    assert len({id(frame.camera) for frame in frames}) == (1 if path is None else len(frames))
    for frame in frames:
        tumour = play.stage.build_tumour(play.estimate_positions(frame))
        mask, ours = (
            drawn_by_opencv(frame.camera, tumour),
            compute_silhouette(frame.camera, tumour.vertices, tumour.triangles),
        )
        middles = [np.argwhere(each).mean(axis=0) for each in (mask, ours)]
        assert mask.sum() > 5000 and np.abs(middles[0] - middles[1]).max() < 0.1 and compute_iou(mask, ours) > 0.985
        assert measure_outline_error(frame, mask) < 2.1  # the outline is smooth
        assert measure_outline_error(frame, np.roll(mask, (4, 4), axis=(0, 1))) > 1.7
        straight = project_cv2(replace(frame.camera, lens=None), tumour.vertices)
        assert np.abs(straight - by_opencv(frame.camera, tumour.vertices)).max() > 3.0


@pytest.mark.parametrize("path", PATHS)
def test_scene_checks_pass_on_path_and_fail_on_other_camera(theatre, path):
    play = filmed(theatre, path=PATHS[path](1), eye="left")
    frames = list(play.play_frames(every=30))
    truth = solve_reference_frames(theatre, play.scene, [frame.loads for frame in frames])
    figures = measure_frames(play, play.get_camera, frames, truth)
    assert not figures.find_violations(Bounds(visible=0.0)) and figures.pixels < 1e-6
    late = measure_frames(play, lambda time: play.get_camera(time + 0.3), frames, truth)
    assert late.find_violations(Bounds(visible=0.0))
    assert measure_frames(play, lambda time: replace(play.get_camera(time), lens=None), frames, truth).find_violations(
        Bounds(visible=0.0)
    )


def test_episodes_store_lens_and_camera_of_each_frame(theatre, tmp_path):
    from scenes.episodes.episode import collect

    play = filmed(theatre, path=Microscope((Focus(0.0, 1.2, 1.5),), 0.2))
    play = player(theatre, replace(play.scene, duration=0.2), "fem")
    collect(tmp_path / "episode.h5", theatre, play, "fem", lambda frames: frames)
    with h5py.File(tmp_path / "episode.h5") as file:
        last = play.get_camera(float(play.scene.times[-1]))
        assert np.array_equal(file["K"][:], play.camera.K) and np.array_equal(file["K_of_frame"][-1], last.K)
        assert not np.array_equal(file["K"][:], last.K) and file["distortion"][:].tolist() == LENS.coefficients.tolist()
        assert np.array_equal(file["T_camera_world"][-1], last.T_camera_world)
        positions = play.site.anatomy.mesh.nodes.copy()
        positions[file["tumour_nodes"][:]] = file["tumour_predicted"][-1]
        camera = Camera(file["K_of_frame"][-1], file["T_camera_world"][-1], file.attrs["width"], file.attrs["height"])
        mask = cv2.imdecode(file["pictures/tumour_mask"][-1], cv2.IMREAD_GRAYSCALE) > 0
        assert (
            mask.sum() > 5000 and compute_iou(mask, drawn_by_opencv(camera, play.stage.build_tumour(positions))) > 0.985
        )

"""Simulated errors of a camera calibration and of detected target corners, for Monte Carlo without images."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.tracking.intrinsics import BoardView, compute_intrinsics_covariance
from ar.tracking.targets import DetectedCorners, Target, build_calibration_board, is_seen_from_front

CORNER_NOISE = 0.1
"""Standard deviation of a corner per axis [pixel]: twice the value of sharp images (`benchmarks track`)."""
VIEW_COUNT = 24  # Number of views of a typical calibration.
MAX_TILT = np.radians(35.0)  # Largest tilt of the board in its views [rad].
BOARD_WIDTHS = (0.45, 0.8)  # Range of the board's width relative to the image width.


def sample_usual_covariance(calibration: Calibration, seed: int = 0) -> np.ndarray:
    """Compute the covariance (9, 9) of a good calibration's intrinsics, ordered as `intrinsics.PARAMETERS`.

    Simulated are 24 views of the printed board at varied distances and positions, with tilts of up to 35 degrees.
    """
    random, board = np.random.default_rng(seed), build_calibration_board().faces[0]
    points = board.corners - np.array([*(0.5 * board.size), 0.0])
    camera, views, poses = calibration.build_camera(np.eye(4)), [], []
    for number in range(VIEW_COUNT):
        az = 2.0 * np.pi * number / VIEW_COUNT
        turn = MAX_TILT * random.uniform(0.5, 1.0) * np.array([np.cos(az), np.sin(az), 0.3 * random.standard_normal()])
        depth = board.size[0] * calibration.focal[0] / (random.uniform(*BOARD_WIDTHS) * calibration.width)
        aside = 0.25 * random.uniform(-1.0, 1.0, 2) * np.array([calibration.width, calibration.height])
        shift = depth * np.array([*(aside / calibration.focal), 1.0])
        at = points @ Rotation.from_rotvec(turn).as_matrix().T + shift
        pixels, _ = camera.project(at)
        inside = np.isfinite(pixels).all(axis=1)
        noisy = pixels + CORNER_NOISE * random.standard_normal(pixels.shape)
        views.append(BoardView(str(number), points[inside], noisy[inside], 1.0))
        poses.append((turn, shift))
    return compute_intrinsics_covariance(calibration, views, poses)[0]


def change_calibration(calibration: Calibration, change: np.ndarray) -> Calibration:
    """Return a calibration with `change` (9,) added to its nine parameters; other lens coefficients stay unchanged."""
    fx, fy, cx, cy = (np.array([*calibration.focal, *calibration.principal]) + change[:4]).tolist()
    coefficients = calibration.lens.coefficients.copy()
    coefficients[:5] += change[4:]
    return replace(calibration, focal=(fx, fy), principal=(cx, cy), lens=Lens(*coefficients.tolist()))


def project_corners(camera: Camera, target: Target, T_world_target: np.ndarray, noise: np.ndarray) -> DetectedCorners:
    """Project the corners of a target's visible faces, and add the rows of `noise` (n, 2) [pixel] as errors."""
    points, faces, T = [], [], camera.T_camera_world @ T_world_target
    for number, face in enumerate(target.faces):
        if is_seen_from_front(T @ face.T_target_face):
            points.append(face.corners)
            faces += [number] * len(face.corners)
    at = np.concatenate([np.zeros((0, 3)), *points])
    pixels, _ = camera.project(at @ T_world_target[:3, :3].T + T_world_target[:3, 3])
    inside = (np.isfinite(pixels) & (pixels >= 0.0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
    return DetectedCorners(at[inside], (pixels + noise[: len(at)])[inside], np.array(faces, int)[inside])


def project_with_shutter(
    corners: DetectedCorners, get_camera: Callable[[float], Camera], readout_time: float, T_world_target: np.ndarray
) -> DetectedCorners:
    """Return detected corners with the shift by a rolling shutter that reads all image rows in `readout_time` [s].

    `get_camera` returns the camera at a delay [s] after the readout of the middle row. Noise in `corners` is kept.
    """
    at = corners.points @ T_world_target[:3, :3].T + T_world_target[:3, 3]
    middle = get_camera(0.0)
    still, _ = middle.project(at)
    moved = [
        get_camera(readout_time * compute_row_delay(middle, row)).project(place[None])[0][0]
        for place, row in zip(at, still[:, 1].tolist(), strict=True)
    ]
    return replace(corners, pixels=corners.pixels + np.reshape(moved, still.shape) - still)


def compute_row_delay(camera: Camera, row: float) -> float:
    """Compute the delay of an image row [pixel] relative to the middle row, as a share of the readout time."""
    return (row + 0.5) / camera.height - 0.5

"""Pictures of the calibration board through a camera with a lens, and views of it without pictures."""

from functools import lru_cache

import cv2
import numpy as np

from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.tracking.intrinsics import BoardView
from ar.tracking.targets import build_calibration_board

FACE = build_calibration_board().faces[0]
K = np.array([[560.0, 0.0, 322.5], [0.0, 556.0, 236.0], [0.0, 0.0, 1.0]])
LENS = Lens(-0.12, 0.06, 8e-4, -6e-4, -0.01)
WIDTH, HEIGHT = 640, 480
CAMERA = Camera(K, np.eye(4), WIDTH, HEIGHT, LENS)
FINE = 3


def poses(count, tilt=35.0, seed=0):
    """Poses of the board before the camera, (count, 4, 4): tilted by up to `tilt` [degree], all over the picture."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        around = 2.0 * np.pi * number / count
        turn = np.radians(tilt) * np.array([np.cos(around), np.sin(around), 0.3 * rng.normal()])
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(turn)[0]
        middle = np.array([0.075 * rng.uniform(-1, 1), 0.055 * rng.uniform(-1, 1), rng.uniform(0.26, 0.36)])
        T[:3, 3] = middle - T[:3, :3] @ [*(0.5 * FACE.size), 0.0]
        found.append(T)
    return np.array(found)


@lru_cache
def rays():
    """Of each fine pixel without the lens (H, W, 3), z = 1."""
    fine = CAMERA.scale(FINE)
    pixels = fine.straight
    homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1)
    return homogeneous @ np.linalg.inv(fine.K).T


@lru_cache
def texture():
    """The board with a white border of a square, and pixels a metre."""
    return np.pad(FACE.draw(160), 160, constant_values=255), 160 / FACE.square


def picture(T):
    """What the camera sees of the board at T (4, 4), grey beside it: (H, W) uint8."""
    printed, per_metre = texture()
    # The plane's places by a homography of rays: the inverse of (x, y) -> x right + y down + origin.
    places = rays() @ np.linalg.inv(T[:3, [0, 1, 3]]).T
    at = places[..., :2] / places[..., 2:]
    at = (at * per_metre + 160 - 0.5).astype(np.float32)
    drawn = cv2.remap(printed, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    return cv2.resize(drawn, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def views(places, noise, seed=0):
    """Corners of the board at poses (n, 4, 4) inside the picture, off by `noise` [pixel]."""
    rng, found = np.random.default_rng(seed), []
    points = np.asarray(FACE.board.getChessboardCorners(), np.float64)
    for number, T in enumerate(places):
        pixels, _ = CAMERA.project(points @ T[:3, :3].T + T[:3, 3])
        inside = ((pixels > 0.0) & (pixels < [WIDTH - 1, HEIGHT - 1])).all(axis=1)
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        found.append(BoardView(f"view {number}", points[inside], pixels[inside], 1.0))
    return found

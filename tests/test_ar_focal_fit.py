"""Focal length estimated from a target with depth."""

from dataclasses import replace

import numpy as np
from films import FILM

from ar.tracking.focal_fit import fit_focal_length
from ar.tracking.targets import DetectedCorners, build_tool_cube
from scenes.tracked.calibration_file import read_calibration

CUBE = build_tool_cube()


def corners_of(camera, noise, seed, faces=(0, 1)):
    """What a camera sees of two faces of the cube, with errors [pixel]."""
    middle = np.concatenate([CUBE.faces[face].corners for face in faces]).mean(axis=0)
    normal = sum(CUBE.faces[face].T_target_face[:3, 2] for face in faces)
    ahead = normal / np.linalg.norm(normal)
    right = np.cross(ahead, [0.31, 0.2, 0.93])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    points = np.concatenate([CUBE.faces[face].corners for face in faces])
    face = np.repeat(faces, [len(CUBE.faces[number].corners) for number in faces])
    pixels = camera.project((points - middle) @ turn.T + [0.0, 0.0, 0.4])[0]
    return DetectedCorners(points, pixels + noise * np.random.default_rng(seed).standard_normal(pixels.shape), face)


def test_focal_length_is_estimated_from_cube_corners():
    """Cases: a focal length that is 10 % too long, a correct one, and too few corners."""
    camera = read_calibration(FILM / "camera.yaml").build_camera(np.eye(4))
    seen = [(CUBE, corners_of(camera, 0.1, seed)) for seed in range(12)]
    for factor in (1.0, 1.1):
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= factor
        fit = fit_focal_length(replace(camera, K=K), seen)
        assert fit is not None and fit.is_significant == (factor > 1.0)
        assert abs(fit.factor * factor - 1.0) < 4.0 * fit.deviation < 0.04
    few = replace(seen[0][1], **{name: getattr(seen[0][1], name)[:8] for name in ("points", "pixels", "face")})
    assert fit_focal_length(camera, [(CUBE, few)]) is None and fit_focal_length(camera, []) is None

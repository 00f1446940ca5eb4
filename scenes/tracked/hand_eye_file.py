"""How a camera lies in what it is fixed to, as `sulcus calibrate --hand-eye --json` prints it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ar.tracking.rigid import is_rigid
from sim.errors import InputError
from sim.runtime.outside_files import path_of, read_as

WANTED = "Give what `sulcus calibrate --hand-eye A.csv B.csv --json` prints, B being the camera."
LARGEST, RIGID = 1 << 16, 1e-4


def read_hand_eye(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """X (4, 4) [m] with x_body = X x_camera, and a covariance (6, 6) of the camera's place [m] and turn [rad] about it.

    The residuals of the motions stand for deviations along and about each axis.

    Raises
    ------
    InputError
        A file that is missing or none such; a transform that is not rigid, or residuals that are none.
    """
    path = path_of(path)
    with read_as(path, "a hand-eye calibration", WANTED):
        with path.open("rb") as file:
            stored = json.loads(file.read(LARGEST))
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = np.array(stored["rotation"], float), 1e-3 * np.array(stored["shift_mm"], float)
        off = np.array([1e-3 * float(stored["rms_mm"]), np.radians(float(stored["rms_degrees"]))])
        if not is_rigid(X, RIGID):
            raise InputError(f"its rotation is none. {WANTED}")
        if not np.isfinite(off).all() or (off < 0.0).any():
            raise InputError(f"its residuals are no lengths. {WANTED}")
        return X, np.diag(np.repeat(off**2, 3))

"""Calibration files of real cameras: intrinsics in OpenCV's and ROS's formats, and hand-eye transforms."""

import json
from pathlib import Path
from typing import Literal

import numpy as np

from ar.optics.calibration import MAX_TEXT_LENGTH, REMEDY, Calibration, parse_calibration, to_opencv_text, to_ros_text
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import to_path, wrap_errors

SUFFIXES = (".yaml", ".yml")  # Endings of calibration files.
INTRINSICS = "sulcus intrinsics"
"""Name of the format of a calibration's covariance file."""
FORMATS = {"opencv": to_opencv_text, "ros": to_ros_text}  # Writers of calibration files, by format.
# Remedy in error messages.
HAND_EYE_REMEDY = "Give what `sulcus calibrate --hand-eye A.csv B.csv --json` prints, B being the camera."
MAX_HAND_EYE_BYTES = 1 << 16  # Maximum size of a hand-eye calibration file [bytes].
ROTATION_TOLERANCE = 1e-4  # Tolerance of a rotation's columns from length 1 and right angles.


def read_calibration(path: str | Path) -> Calibration:
    """Read a camera's calibration from a YAML file in the format of OpenCV or of ROS's camera_info.

    Keys: image_width, image_height, camera_matrix, distortion_coefficients; ROS: also distortion_model.

    Raises
    ------
    InputError
        The file is missing, too large or of another kind, or `ar.optics.calibration.parse_calibration` rejects its
        content.
    """
    path = to_path(path)
    with wrap_errors(path, "a camera's calibration", REMEDY):
        if path.exists() and not path.is_file():
            raise InputError(f"is no file. {REMEDY}")
        with path.open("rb") as file:
            text = file.read(4 * MAX_TEXT_LENGTH + 1).decode("utf-8-sig")
        try:
            return parse_calibration(text)
        except ValueError as error:
            raise InputError(str(error)) from error


def read_intrinsic_covariance(path: str | Path) -> np.ndarray | None:
    """Read the covariance (9, 9) of a calibration K.yaml from the K.json of `sulcus calibrate`; None: no such file.

    Raises
    ------
    InputError
        The file exists, and its covariance is invalid.
    """
    beside = to_path(path).with_suffix(".json")
    if not beside.is_file() or beside.stat().st_size > MAX_TEXT_LENGTH:
        return None
    with wrap_errors(beside, "a covariance of `sulcus calibrate`", "Remove it, or calibrate the camera again."):
        stored = json.loads(beside.read_text(encoding="utf-8-sig"))
        if not isinstance(stored, dict) or not str(stored.get("format", "")).startswith(INTRINSICS):
            return None
        covariance = np.array(stored["covariance"], float)
        if covariance.shape != (9, 9) or not np.isfinite(covariance).all() or np.diag(covariance).min() < 0.0:
            raise InputError("its covariance is none of 9 x 9.")
        return 0.5 * (covariance + covariance.T)


def build_intrinsics_header(calibration: Calibration, covariance: np.ndarray) -> dict[str, object]:
    """Build the content of a calibration's K.json: 9 parameters and their covariance (9, 9), 0 if they are exact."""
    from ar.tracking.intrinsics import PARAMETERS, to_parameters

    return {
        "format": f"{INTRINSICS} 1",
        "image_width": calibration.width,
        "image_height": calibration.height,
        "parameters": PARAMETERS,
        "values": to_parameters(calibration).tolist(),
        "standard_deviations": np.sqrt(np.diag(covariance)).tolist(),
        "covariance": covariance.tolist(),
    }


def write_exact_intrinsics(path: str | Path, calibration: Calibration) -> None:
    """Write the K.json of an exactly known camera, for example of a rendered video, atomically.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    with write_atomically(to_path(path), ".json") as partial:
        partial.write_text(json.dumps(build_intrinsics_header(calibration, np.zeros((9, 9)))) + "\n", encoding="utf-8")


def write_calibration(path: str | Path, calibration: Calibration, form: Literal["opencv", "ros"] = "opencv") -> None:
    """Write a calibration as a YAML file (.yaml, .yml) in OpenCV's or ROS's format, atomically.

    Raises
    ------
    InputError
        The format is unknown, the file ending is wrong, or the file cannot be written.
    """
    path = to_path(path)
    if form not in FORMATS:
        raise InputError(f"calibrations are written as {' or '.join(FORMATS)}, not as {form!r}: choose one.")
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: calibrations are written as {' or '.join(SUFFIXES)}; give a name that ends so.")
    with write_atomically(path, path.suffix) as partial:
        partial.write_text(FORMATS[form](calibration), encoding="utf-8")


def read_hand_eye(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a hand-eye transform X (4, 4) [m], x_body = X x_camera, and its covariance (6, 6) of position and rotation.

    The file's residuals are used as standard deviations along each axis [m] and about each axis [rad].

    Raises
    ------
    InputError
        The file is missing or invalid, the transform is not rigid, or the residuals are invalid.
    """
    from ar.tracking.rigid import is_rigid

    path = to_path(path)
    with wrap_errors(path, "a hand-eye calibration", HAND_EYE_REMEDY):
        with path.open("rb") as file:
            stored = json.loads(file.read(MAX_HAND_EYE_BYTES))
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = np.array(stored["rotation"], float), 1e-3 * np.array(stored["shift_mm"], float)
        off = np.array([1e-3 * float(stored["rms_mm"]), np.radians(float(stored["rms_degrees"]))])
        if not is_rigid(X, ROTATION_TOLERANCE):
            raise InputError(f"its rotation is none. {HAND_EYE_REMEDY}")
        if not np.isfinite(off).all() or (off < 0.0).any():
            raise InputError(f"its residuals are no lengths. {HAND_EYE_REMEDY}")
        return X, np.diag(np.repeat(off**2, 3))

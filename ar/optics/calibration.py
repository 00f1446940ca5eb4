"""What a calibration says of a camera, and its text as OpenCV and ROS write it.

OpenCV: `cv2.FileStorage` with the names of its calibration sample. ROS: the camera_info of camera_calibration_parsers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import cv2
import numpy as np

from .camera import Camera
from .lens import Lens

# Pixels along a side.
LARGEST_SIDE = 16384
READOUT = "readout_time"
"""The key of a rolling shutter's readout [s]: neither OpenCV nor ROS has one, and both leave it alone."""
# Of a camera's name.
LONGEST = 256
# From the first row of a picture to the last [s].
LONGEST_READOUT = 1.0


@dataclass(frozen=True)
class Calibration:
    """The inside of a camera.

    Parameters
    ----------
    focal, principal
        Focal lengths, and the principal point, along columns and rows [pixel]; whole numbers are pixel centres.
    width, height
        Size of the picture [pixel].
    lens
        How its lens distorts.
    name
        Of the camera; may be empty.
    readout
        How much later the last row of a picture is taken than the first [s]: of a rolling shutter. A picture's time is
        that of its middle row.

    Raises
    ------
    ValueError
        A picture, a focal length, a principal point or a readout that no camera has.
    """

    focal: tuple[float, float]
    principal: tuple[float, float]
    width: int
    height: int
    lens: Lens = field(default_factory=Lens)
    name: str = ""
    readout: float = 0.0

    def __post_init__(self) -> None:
        for what, pixels in (("width", self.width), ("height", self.height)):
            if not 1 <= pixels <= LARGEST_SIDE:
                raise ValueError(
                    f"a picture has an image_{what} of 1 to {LARGEST_SIDE}, not {pixels}: calibrate again."
                )
        if not 0.0 <= self.readout <= LONGEST_READOUT:
            raise ValueError(
                f"a picture's rows are read in 0 to {LONGEST_READOUT:g} s, not in {self.readout:g}: give another "
                f"{READOUT} [s]."
            )
        if not all(0.0 < each < np.inf for each in self.focal):
            raise ValueError(f"focal lengths are numbers of pixels above 0, not {self.focal}: calibrate again.")
        for at, size in zip(self.principal, (self.width, self.height), strict=True):
            if not -size <= at <= 2 * size:
                raise ValueError(
                    f"the principal point {self.principal} is far outside a picture of {self.width} x {self.height}: "
                    "give the size that the camera was calibrated with."
                )
        if len(self.name) > LONGEST or not (self.name + "x").isprintable():
            raise ValueError(f"a camera's name has at most {LONGEST} characters that can be printed: shorten it.")

    @property
    def K(self) -> np.ndarray:
        """(3, 3) intrinsics [pixel]."""
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def camera(self, T_camera_world: np.ndarray) -> Camera:
        """The camera at a pose, (4, 4) as in `Camera`; errors as there."""
        return Camera(self.K, T_camera_world, self.width, self.height, self.lens)

    def sized(self, width: int, height: int, scale: bool = False) -> Calibration:
        """The same camera with pictures of another size, if `scale` is set and the picture has the same shape.

        Raises
        ------
        ValueError
            Another size, and it is not to be scaled; or a picture of another shape.
        """
        if (width, height) == (self.width, self.height):
            return self
        here = f"the camera was calibrated with pictures of {self.width} x {self.height}, not {width} x {height}"
        if not scale:
            raise ValueError(f"{here}: calibrate with that size, or ask for the calibration to be scaled.")
        larger = self.camera(np.eye(4)).scaled(width / self.width)
        if (larger.width, larger.height) != (width, height):
            raise ValueError(f"{here}, which have another shape: choose a size of the same shape.")
        (fx, _, cx), (_, fy, cy) = larger.K[:2].tolist()
        return Calibration((fx, fy), (cx, cy), width, height, self.lens, self.name, self.readout)


def opencv_text(calibration: Calibration) -> str:
    """A calibration as `cv2.FileStorage` writes it in YAML; five coefficients, or eight of a rational lens."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", calibration.width)
    storage.write("image_height", calibration.height)
    storage.write("camera_name", calibration.name)
    storage.write("camera_matrix", calibration.K)
    storage.write("distortion_coefficients", coefficients_of(calibration.lens)[:, None])
    if calibration.readout > 0.0:
        storage.write(READOUT, calibration.readout)
    return storage.releaseAndGetString()


def ros_text(calibration: Calibration) -> str:
    """A calibration as ROS's camera_info in YAML, of the model plumb_bob, or rational_polynomial where that is needed.

    Its rectification is none, and its projection that of the camera matrix.
    """
    coefficients = coefficients_of(calibration.lens)
    lines = [
        f"image_width: {calibration.width}",
        f"image_height: {calibration.height}",
        f"camera_name: {json.dumps(calibration.name, ensure_ascii=False)}",
    ]
    lines += _matrix("camera_matrix", calibration.K)
    lines += [f"distortion_model: {'plumb_bob' if len(coefficients) == 5 else 'rational_polynomial'}"]
    lines += _matrix("distortion_coefficients", coefficients[None])
    lines += _matrix("rectification_matrix", np.eye(3))
    lines += _matrix("projection_matrix", np.hstack([calibration.K, np.zeros((3, 1))]))
    lines += [f"{READOUT}: {calibration.readout!r}"] if calibration.readout > 0.0 else []
    return "\n".join(lines) + "\n"


def coefficients_of(lens: Lens) -> np.ndarray:
    """(5,) or, of a rational lens, (8,), in OpenCV's order."""
    return lens.coefficients if lens.coefficients[5:].any() else lens.coefficients[:5]


def _matrix(name: str, values: np.ndarray) -> list[str]:
    rows, columns = values.shape
    numbers = ", ".join(repr(value) for value in values.ravel().tolist())
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{numbers}]"]

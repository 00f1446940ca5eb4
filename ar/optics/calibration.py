"""Intrinsic calibration of a camera, and its text in the formats of OpenCV and ROS.

OpenCV: `cv2.FileStorage` with the keys of OpenCV's calibration sample. ROS: camera_info of camera_calibration_parsers.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field

import cv2
import numpy as np

from .camera import Camera
from .lens import Lens

MAX_IMAGE_SIDE = 16384  # Largest image side [pixel].
READOUT_KEY = "readout_time"
"""Key of a rolling shutter's readout time [s]; OpenCV and ROS have no such key, and ignore it."""
MAX_NAME_LENGTH = 256  # Maximum length of a camera's name [characters].
MAX_READOUT = 1.0  # Largest readout time, from the first row of an image to the last [s].


@dataclass(frozen=True)
class Calibration:
    """Intrinsic calibration of a camera.

    Parameters
    ----------
    focal, principal
        Focal lengths and principal point along columns and rows [pixel]; integer positions are pixel centres.
    width, height
        Size of the image [pixel].
    lens
        Lens distortion.
    name
        Name of the camera; may be empty.
    readout
        Rolling-shutter readout time [s] from the first row of an image to the last. The time of an image is that of its
        middle row.

    Raises
    ------
    ValueError
        An image size, focal length, principal point, readout time or name is out of range.
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
            if not 1 <= pixels <= MAX_IMAGE_SIDE:
                raise ValueError(f"an image_{what} of 1 to {MAX_IMAGE_SIDE}, not {pixels}: calibrate again.")
        if not 0.0 <= self.readout <= MAX_READOUT:
            raise ValueError(
                f"an image's rows are read in 0 to {MAX_READOUT:g} s, not in {self.readout:g}: give another "
                f"{READOUT_KEY} [s]."
            )
        if not all(0.0 < each < np.inf for each in self.focal):
            raise ValueError(f"focal lengths are numbers of pixels above 0, not {self.focal}: calibrate again.")
        for at, size in zip(self.principal, (self.width, self.height), strict=True):
            if not -size <= at <= 2 * size:
                raise ValueError(
                    f"the principal point {self.principal} is far outside an image of {self.width} x {self.height}: "
                    "give the size that the camera was calibrated with."
                )
        if len(self.name) > MAX_NAME_LENGTH or not (self.name + "x").isprintable():
            raise ValueError(
                f"a camera's name has at most {MAX_NAME_LENGTH} characters that can be printed: shorten it."
            )

    @property
    def K(self) -> np.ndarray:
        """Intrinsic camera matrix (3, 3) [pixel]."""
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def build_camera(self, T_camera_world: np.ndarray) -> Camera:
        """Return the camera at the pose T_camera_world (4, 4) [m]; raises ValueError as `Camera`."""
        return Camera(self.K, T_camera_world, self.width, self.height, self.lens)

    def resize_calibration(self, width: int, height: int, allow_scaling: bool = False) -> Calibration:
        """Return the calibration for another image size; this needs `allow_scaling` and the same aspect ratio.

        Raises
        ------
        ValueError
            The size differs without `allow_scaling`, or the aspect ratio differs.
        """
        if (width, height) == (self.width, self.height):
            return self
        here = f"the camera was calibrated with images of {self.width} x {self.height}, not {width} x {height}"
        if not allow_scaling:
            raise ValueError(f"{here}: calibrate with that size, or ask for the calibration to be scaled.")
        larger = self.build_camera(np.eye(4)).scale(width / self.width)
        if (larger.width, larger.height) != (width, height):
            raise ValueError(f"{here}, which have another shape: choose a size of the same shape.")
        (fx, _, cx), (_, fy, cy) = larger.K[:2].tolist()
        return Calibration((fx, fy), (cx, cy), width, height, self.lens, self.name, self.readout)


def to_opencv_text(calibration: Calibration) -> str:
    """Format a calibration as YAML of `cv2.FileStorage`, with five coefficients, or eight for a rational lens."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", calibration.width)
    storage.write("image_height", calibration.height)
    storage.write("camera_name", calibration.name)
    storage.write("camera_matrix", calibration.K)
    storage.write("distortion_coefficients", to_opencv_coefficients(calibration.lens)[:, None])
    if calibration.readout > 0.0:
        storage.write(READOUT_KEY, calibration.readout)
    return storage.releaseAndGetString()


def to_ros_text(calibration: Calibration) -> str:
    """Format a calibration as YAML of ROS's camera_info; lens model plumb_bob, or rational_polynomial if needed.

    As images are not rectified, the projection matrix equals the camera matrix.
    """
    coefficients = to_opencv_coefficients(calibration.lens)
    lines = [
        f"image_width: {calibration.width}",
        f"image_height: {calibration.height}",
        f"camera_name: {json.dumps(calibration.name, ensure_ascii=False)}",
    ]
    lines += _format_matrix("camera_matrix", calibration.K)
    lines += [f"distortion_model: {'plumb_bob' if len(coefficients) == 5 else 'rational_polynomial'}"]
    lines += _format_matrix("distortion_coefficients", coefficients[None])
    lines += _format_matrix("rectification_matrix", np.eye(3))
    lines += _format_matrix("projection_matrix", np.hstack([calibration.K, np.zeros((3, 1))]))
    lines += [f"{READOUT_KEY}: {calibration.readout!r}"] if calibration.readout > 0.0 else []
    return "\n".join(lines) + "\n"


def to_opencv_coefficients(lens: Lens) -> np.ndarray:
    """Return the lens coefficients in OpenCV's order, (5,), or (8,) for a rational lens."""
    return lens.coefficients if lens.coefficients[5:].any() else lens.coefficients[:5]


def _format_matrix(name: str, values: np.ndarray) -> list[str]:
    rows, columns = values.shape
    numbers = ", ".join(repr(value) for value in values.ravel().tolist())
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{numbers}]"]


MAX_TEXT_LENGTH = 64 * 1024  # Maximum length of a calibration file [characters]; about a thousand are usual.
MAX_NESTING = 4  # Maximum nesting depth of brackets: OpenCV's parser is recursive, and a calibration needs two.
# Minimum number of coefficients of the distortion models named by ROS.
MIN_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8}
# Allowed numbers of distortion coefficients in OpenCV; those after the eighth are of thin prisms and tilted sensors.
COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
KEYS = (
    "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "distortion_coefficients",
    "rectification_matrix", "projection_matrix", "fisheye_model", READOUT_KEY,
)  # fmt: skip
"""Keys of a calibration file that are read."""
# Pattern of a YAML list of numbers, one on each line.
BLOCK_LIST = re.compile(r"^(( *)data: *)\n((?:\2 *- *[-+.\w]+ *\n)+)", re.MULTILINE)
ITEM = re.compile(r"^ *- *([-+.\w]+)", re.MULTILINE)
"""Pattern of a number in such a list."""
# Pattern of a camera name without quotes.
NAME_LINE = re.compile(r"^(camera_name:[ \t]+)([^\s\"'\[{][^\n\"#]*?)[ \t]*$", re.MULTILINE)
OTHER_LINE = re.compile(rf"^(?!(?:{'|'.join(KEYS)})\b)\w+:[ \t]+[^\s\[{{|>&!][^\n]*\n", re.MULTILINE)
"""Pattern of a one-line entry with a key that is not read."""
REMEDY = (  # Required content of the file, in error messages.
    "Give YAML with image_width, image_height, camera_matrix and distortion_coefficients, as OpenCV or ROS writes it."
)


def parse_calibration(text: str) -> Calibration:
    """Parse a calibration from YAML of `cv2.FileStorage` or of ROS's camera_info.

    With four coefficients (k1 k2 p1 p2), k3 is 0. More than eight are accepted if those after the eighth are 0.

    Raises
    ------
    ValueError
        The text is too long or not valid YAML. An entry is missing, given twice, of another shape, or not finite. The
        lens or distortion model is not supported. Errors of `Calibration`.
    """
    storage = _open_text(text)
    root = storage.root()
    keys = [] if root.empty() or not root.isMap() else list(root.keys())
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ValueError(f"{twice[0][:40]} is given twice: leave one out.")
    missing = [key for key in ("image_width", "image_height", "camera_matrix") if key not in keys]
    if missing:
        raise ValueError(f"{missing[0]} is missing. {REMEDY}")
    if "fisheye_model" in keys and not (root.getNode("fisheye_model").isInt() and not _read_int(root, "fisheye_model")):
        raise ValueError("the camera was calibrated as a fisheye: calibrate it without CALIB_FISHEYE.")
    K = _read_matrix(root, "camera_matrix", (3, 3))
    if not K.any():
        raise ValueError("camera_matrix is all 0, as of a camera that is not calibrated: calibrate it first.")
    if K[0, 1] or K[1, 0] or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        raise ValueError("camera_matrix must be (fx 0 cx; 0 fy cy; 0 0 1): calibrate without skew.")
    for key, shape in (("rectification_matrix", (3, 3)), ("projection_matrix", (3, 4))):
        if key in keys:
            _read_matrix(root, key, shape)  # checked only: the matrix is for rectified images, which are not used
    (fx, _, cx), (_, fy, cy) = K[:2].tolist()
    width, height = (_read_int(root, key) for key in ("image_width", "image_height"))
    lens, name = _read_lens(root, keys), _read_name(root, keys)
    return Calibration((fx, fy), (cx, cy), width, height, lens, name, _read_readout(root, keys))


def _open_text(text: str) -> cv2.FileStorage:
    """Open the text with OpenCV; ValueError if it is too long or not valid YAML."""
    if len(text) > MAX_TEXT_LENGTH:
        raise ValueError(f"it has more than {MAX_TEXT_LENGTH} characters, and a calibration some thousand. {REMEDY}")
    text = text.removeprefix("\ufeff").replace("\r\n", "\n")
    if not text.replace("\n", "").replace("\t", "").isprintable() or text.lstrip().startswith("<"):
        raise ValueError(f"it is no YAML. {REMEDY}")
    deep = np.cumsum([(sign in "[{") - (sign in "]}") for sign in text])
    if deep.max(initial=0) > MAX_NESTING or re.search(r"^[ \t]*(?:[^\n]*:)?(?:[ \t]*-[ \t]){2}", text, re.MULTILINE):
        raise ValueError(f"its lists are nested too deeply. {REMEDY}")
    text = _convert_text(text)
    if not text.startswith("%YAML"):
        text = "%YAML:1.0\n---\n" + re.sub(r"\A\s*---[ \t]*\n", "", text)
    try:
        return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:  # a failing constructor raises SystemError
        raise ValueError(f"it is no YAML that OpenCV reads: set lists in brackets, or indent them. {REMEDY}") from error


def _convert_text(text: str) -> str:
    """Convert the text for OpenCV's parser: lists in brackets, names in quotes, and only the keys that are read."""
    text = BLOCK_LIST.sub(lambda found: f"{found[1]}[{', '.join(ITEM.findall(found[3]))}]\n", text)
    return OTHER_LINE.sub("", NAME_LINE.sub(r'\1"\2"', text))


def _read_int(root: cv2.FileNode, key: str) -> int:
    node = root.getNode(key)
    if not node.isInt():
        raise ValueError(f"{key} must be a whole number. {REMEDY}")
    return int(node.real())


def _read_matrix(root: cv2.FileNode, key: str, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Read a matrix of finite numbers; memory is allocated by its actual size, not its declared size."""
    node = root.getNode(key)
    if not node.isMap() or not {"rows", "cols", "data"} <= set(node.keys()):
        raise ValueError(f"{key} must have rows, cols and data. {REMEDY}")
    rows, columns, data = _read_int(node, "rows"), _read_int(node, "cols"), node.getNode("data")
    found = [data.at(index) for index in range(data.size())] if data.isSeq() else []
    wanted = "" if shape is None else f", which must be {shape[0]} x {shape[1]}"
    if rows * columns != len(found) or rows < 0 or (shape is not None and (rows, columns) != shape):
        raise ValueError(f"{key} says {rows} x {columns}{wanted}, and has {len(found)} numbers. {REMEDY}")
    if not all(each.isReal() or each.isInt() for each in found):
        raise ValueError(f"{key} holds what is no number. {REMEDY}")
    values = np.array([each.real() for each in found], np.float64).reshape(rows, columns)
    if not np.isfinite(values).all():
        raise ValueError(f"{key} holds a number that is not finite: calibrate again.")
    return values


def _read_lens(root: cv2.FileNode, keys: list[str]) -> Lens:
    """Read the lens distortion; ValueError if the model is not supported."""
    if "distortion_coefficients" not in keys:
        raise ValueError(f"distortion_coefficients is missing; five times 0 for no distortion. {REMEDY}")
    values = _read_matrix(root, "distortion_coefficients")
    count = values.size
    if min(values.shape) != 1 or count not in COEFFICIENT_COUNTS:
        raise ValueError(f"distortion_coefficients has {count} numbers in {values.shape}: give a row of 4, 5 or 8.")
    if "distortion_model" in keys:
        node = root.getNode("distortion_model")
        model = node.string() if node.isString() else ""
        if model not in MIN_COEFFICIENTS:
            raise ValueError(
                f"the distortion_model {model[:40]!r} is not known: choose one of {', '.join(MIN_COEFFICIENTS)}."
            )
        if count < MIN_COEFFICIENTS[model] or (model == "plumb_bob" and count != 5):
            raise ValueError(
                f"the distortion_model {model} has {MIN_COEFFICIENTS[model]} coefficients, not {count}: give those."
            )
    numbers = values.ravel().tolist()
    if any(numbers[8:]):
        raise ValueError("a thin prism or a tilted sensor is not drawn: calibrate with at most 8 coefficients.")
    return Lens(*numbers[:8])


def _read_readout(root: cv2.FileNode, keys: list[str]) -> float:
    """Read the readout time of a rolling shutter [s]; 0 if the text has none."""
    if READOUT_KEY not in keys:
        return 0.0
    node = root.getNode(READOUT_KEY)
    if not (node.isReal() or node.isInt()):
        raise ValueError(f"{READOUT_KEY} must be a number of seconds, such as 0.02.")
    return float(node.real())


def _read_name(root: cv2.FileNode, keys: list[str]) -> str:
    """Read the camera's name; empty if the text has none."""
    if "camera_name" not in keys:
        return ""
    node = root.getNode("camera_name")
    if not node.isString():
        raise ValueError("camera_name must be text: put it into quotes.")
    return node.string()

"""Printed targets (tool cube, patient reference, calibration board), and detection of their corners in an image.

Every face is a ChArUco board with odd numbers of squares; its corners are the inner corners of the chessboard. OpenCV
detects these with an error of 0.1 pixel. The error of the markers' own corners is 0.2 pixel, biased inwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera

MARKER_DICTIONARY = cv2.aruco.DICT_4X4_250  # ArUco dictionary of the targets.
MARKER_RATIO = 0.75  # Side of a marker as a share of its square.
Window = tuple[slice, slice]
"""Rows and columns of an image part, as slices with start and stop."""
# Smallest and largest width of the adaptive threshold's window [pixel]: for searching, and for tracking.
SEARCH_WINDOWS, TRACKING_WINDOWS = (5, 25), (15, 15)
MIN_PART_SIDE = 16  # Smallest side of an image part that can hold a marker [pixel].


@dataclass(frozen=True, eq=False)
class Face:
    """Printed face of a target: a chessboard with a marker in every second square.

    Parameters
    ----------
    columns, rows
        Numbers of squares, both odd.
    square
        Side of a square [m].
    first_marker
        Number of the face's first marker in the dictionary; the other numbers follow.
    T_target_face
        Pose (4, 4) [m] of the face; its frame has its origin in the upper left corner, x right, y down, z inwards.
    """

    columns: int
    rows: int
    square: float
    first_marker: int
    T_target_face: np.ndarray

    @property
    def ids(self) -> np.ndarray:
        """Numbers (n,) of the face's markers in the dictionary."""
        return self.first_marker + np.arange(self.columns * self.rows // 2)

    @property
    def size(self) -> np.ndarray:
        """Width and height (2,) [m] of the chessboard."""
        return self.square * np.array([self.columns, self.rows])

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """ChArUco board as an OpenCV object, in metres."""
        dictionary = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, MARKER_RATIO * self.square, dictionary, self.ids
        )

    @cached_property
    def corners(self) -> np.ndarray:
        """Inner corners (n, 3) [m] of the chessboard in the target's frame, in OpenCV's order."""
        own = np.asarray(self.board.getChessboardCorners(), np.float64).reshape(-1, 3)
        return own @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    @property
    def outline(self) -> np.ndarray:
        """Outer corners (4, 3) [m] of the chessboard in the target's frame, clockwise from the upper left one."""
        own = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        return (own * [*self.size, 1.0]) @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    def draw(self, square_pixels: int) -> np.ndarray:
        """Draw the face (H, W) uint8, with `square_pixels` along a square's side, which must be a multiple of 8."""
        return np.asarray(
            self.board.generateImage((square_pixels * self.columns, square_pixels * self.rows), marginSize=0)
        )


@dataclass(frozen=True, eq=False)
class Target:
    """Rigid body with printed faces, whose pose a camera can determine.

    Parameters
    ----------
    name
        Name of the target in files and messages.
    faces
        Faces of the target, each with its own markers.
    """

    name: str
    faces: tuple[Face, ...]

    @property
    def outline(self) -> np.ndarray:
        """Outer corners (n, 3) [m] of all faces in the target's frame."""
        return np.concatenate([face.outline for face in self.faces])


def is_seen_from_front(T_camera_face: np.ndarray) -> bool:
    """Return True if the camera sees the printed side of a face with pose `T_camera_face` (4, 4)."""
    return bool(T_camera_face[:3, 2] @ T_camera_face[:3, 3] > 0.0)


CUBE_SQUARE = 8e-3  # Side of a square of the cube's faces [m].
BORDER_WIDTH = 4e-3  # Width of the white border round the squares of a face [m].
TIP_DISTANCE = 150e-3  # Distance of the tool's tip from the centre of its cube along the shaft [m].


@lru_cache
def build_tool_cube() -> Target:
    """Build the tool's cube, 48 mm wide, with three faces; its frame has its origin in the centre, z along the shaft.

    The faces point along +x, +y and +z, so that a camera opposite their common corner sees all three. The tool's tip is
    nominally at (0, 0, -150) mm.
    """
    half, wide = 2.5 * CUBE_SQUARE, 2.5 * CUBE_SQUARE + BORDER_WIDTH
    # Columns: right and down of a face as it is seen from outside, and into the cube.
    axes = (
        np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
        np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
    )
    faces = []
    for number, rotation in enumerate(axes):
        T = np.eye(4)
        T[:3, :3] = rotation
        T[:3, 3] = -wide * rotation[:, 2] - half * (rotation[:, 0] + rotation[:, 1])
        faces.append(Face(5, 5, CUBE_SQUARE, 12 * number, T))
    return Target("tool", tuple(faces))


@lru_cache
def build_patient_reference() -> Target:
    """Build the patient's reference, a plate of 60 mm to fix next to the craniotomy; its frame is that of its face."""
    return Target("patient", (Face(5, 5, 12e-3, 36, np.eye(4)),))


@lru_cache
def build_calibration_board() -> Target:
    """Build the calibration board of 9 x 7 squares of 24 mm, which fits on A4; its frame is that of its face."""
    return Target("board", (Face(9, 7, 24e-3, 48, np.eye(4)),))


def list_targets() -> tuple[Target, Target, Target]:
    """Return the tool's cube, the patient's reference and the calibration board."""
    return build_tool_cube(), build_patient_reference(), build_calibration_board()


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Corners of one target that were detected in an image.

    Parameters
    ----------
    points
        Corners (n, 3) [m] in the target's frame.
    pixels
        Detected positions (n, 2) [pixel] of these corners.
    face
        Index (n,) of the face that each corner belongs to.
    """

    points: np.ndarray
    pixels: np.ndarray
    face: np.ndarray


@dataclass(frozen=True, eq=False)
class Detector:
    """Detector of target corners in images: markers are detected once, and give the corners of each face.

    Parameters
    ----------
    targets
        Targets with different names and different markers.
    """

    targets: Sequence[Target]
    _thorough: cv2.aruco.ArucoDetector = field(init=False, repr=False)
    _quick: dict[str, cv2.aruco.ArucoDetector] = field(init=False, repr=False)
    _boards: dict[tuple[str, int], cv2.aruco.CharucoDetector] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        quick = {
            target.name: cv2.aruco.ArucoDetector(_build_dictionary([target]), _build_parameters(*TRACKING_WINDOWS))
            for target in self.targets
        }
        thorough = cv2.aruco.ArucoDetector(_build_dictionary(self.targets), _build_parameters(*SEARCH_WINDOWS))
        boards = {
            (target.name, number): cv2.aruco.CharucoDetector(face.board)
            for target in self.targets
            for number, face in enumerate(target.faces)
        }
        object.__setattr__(self, "_thorough", thorough)
        object.__setattr__(self, "_quick", quick)
        object.__setattr__(self, "_boards", boards)

    def detect(self, grey: np.ndarray, names: Sequence[str] = ()) -> dict[str, DetectedCorners]:
        """Detect corners in an image (H, W) uint8; return them by target name, without targets that are not visible.

        Only targets with the given `names` are detected; without names, all targets.
        """
        corners, known = _detect_markers(self._thorough, self.targets, np.ascontiguousarray(grey))
        wanted = [target for target in self.targets if not names or target.name in names]
        found = {target.name: self._interpolate_corners(target, grey, corners, known) for target in wanted}
        return {name: each for name, each in found.items() if len(each.points)}

    def detect_in_window(self, target: Target, grey: np.ndarray, window: Window) -> DetectedCorners | None:
        """Detect a target's corners in a window of an image (H, W) uint8, faster than `detect`; None without any."""
        part = np.ascontiguousarray(grey[window])
        if min(part.shape) < MIN_PART_SIDE:
            return None
        found = self._interpolate_corners(target, part, *_detect_markers(self._quick[target.name], [target], part))
        return replace(found, pixels=found.pixels + [window[1].start, window[0].start]) if len(found.points) else None

    def _interpolate_corners(
        self, target: Target, grey: np.ndarray, markers: np.ndarray, ids: np.ndarray
    ) -> DetectedCorners:
        """Interpolate a target's chessboard corners from its markers' corners (n, 1, 4, 2) with numbers `ids` (n,)."""
        points, pixels, on = [np.zeros((0, 3))], [np.zeros((0, 2))], [np.zeros(0, int)]
        for number, face in enumerate(target.faces):
            mine = np.isin(ids, face.ids)
            if not mine.any():
                continue
            found, which, *_ = self._boards[target.name, number].detectBoard(
                grey, markerCorners=list(markers[mine]), markerIds=ids[mine].reshape(-1, 1).astype(np.int32)
            )
            rows = np.zeros(0, int) if which is None else np.asarray(which, int).reshape(-1)
            if len(rows):
                points.append(face.corners[rows])
                pixels.append(np.asarray(found, np.float64).reshape(-1, 2))
                on.append(np.full(len(rows), number))
        return DetectedCorners(np.concatenate(points), np.concatenate(pixels), np.concatenate(on))


def find_window(camera: Camera, points: np.ndarray, relative_margin: float, min_margin: float) -> Window | None:
    """Return the image part round points (n, 3) [m] in the camera's frame; None if they are out of view.

    The margin is `relative_margin` x the points' extent, at least `min_margin` pixels. The camera is at the origin.
    """
    pixels = camera.project(points)[0]
    pixels = pixels[~np.isnan(pixels).any(axis=1)]
    if not len(pixels):
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    wide, limits = np.maximum(relative_margin * (high - low), min_margin), [camera.width, camera.height]
    left, top = np.clip(low - wide, 0, limits).astype(int).tolist()
    right, bottom = np.clip(high + wide + 1.0, 0, limits).astype(int).tolist()
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def _detect_markers(
    detector: cv2.aruco.ArucoDetector, targets: Sequence[Target], grey: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Detect markers in an image; return their corners (n, 1, 4, 2) [pixel] and their numbers (n,)."""
    corners, ids, _ = detector.detectMarkers(grey)
    which = np.zeros(0, int) if ids is None else np.asarray(ids, int).reshape(-1)
    return np.asarray(corners, np.float32).reshape(-1, 1, 4, 2), _list_marker_ids(targets)[which]


def _list_marker_ids(targets: Sequence[Target]) -> np.ndarray:
    """Return the sorted marker numbers (n,) of targets."""
    return np.sort(np.concatenate([face.ids for target in targets for face in target.faces]))


def _build_dictionary(targets: Sequence[Target]) -> cv2.aruco.Dictionary:
    """Return a dictionary with only the targets' markers, because comparing with each marker takes most of the time."""
    whole = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
    return cv2.aruco.Dictionary(whole.bytesList[_list_marker_ids(targets)], whole.markerSize)


def _build_parameters(min_marker_width: int, max_marker_width: int) -> cv2.aruco.DetectorParameters:
    """Build detector parameters with the threshold window widths `min_marker_width` and `max_marker_width` [pixel]."""
    found = cv2.aruco.DetectorParameters()
    found.adaptiveThreshWinSizeMin, found.adaptiveThreshWinSizeMax = min_marker_width, max_marker_width
    found.adaptiveThreshWinSizeStep = max(max_marker_width - min_marker_width, 1)
    return found

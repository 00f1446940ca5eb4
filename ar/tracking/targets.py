"""Printed targets: the tool's cube, the patient's reference, the calibration board; and their corners in an image.

Every face is a ChArUco board of odd by odd squares, whose corners are those of a chessboard. OpenCV's error is a
tenth of a pixel for them, and a fifth for the markers' own corners, which are always detected too far inwards.
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
"""Rows and columns of an image, with start and stop."""
# Smallest and largest width of the adaptive threshold's window [pixel], for all and for known targets.
SEARCH_WINDOWS, TRACKING_WINDOWS = (5, 25), (15, 15)
MIN_PART_SIDE = 16  # Smallest side of an image part that can hold a marker [pixel].


@dataclass(frozen=True, eq=False)
class Face:
    """One printed face: a chessboard with a marker in every second square.

    Parameters
    ----------
    columns, rows
        Squares, both odd.
    square
        Side of a square [m].
    first_marker
        Number of its first marker in the dictionary; the others follow.
    T_target_face
        (4, 4): the face's frame has its origin in the upper left corner, x to the right, y down, z into the target.
    """

    columns: int
    rows: int
    square: float
    first_marker: int
    T_target_face: np.ndarray

    @property
    def ids(self) -> np.ndarray:
        """Numbers of its markers (n,)."""
        return self.first_marker + np.arange(self.columns * self.rows // 2)

    @property
    def size(self) -> np.ndarray:
        """Width and height (2,) [m]."""
        return self.square * np.array([self.columns, self.rows])

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """ChArUco board as an object of OpenCV, in metres."""
        dictionary = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, MARKER_RATIO * self.square, dictionary, self.ids
        )

    @cached_property
    def corners(self) -> np.ndarray:
        """Inner corners of the chessboard in the target's frame (n, 3) [m], in OpenCV's order."""
        own = np.asarray(self.board.getChessboardCorners(), np.float64).reshape(-1, 3)
        return own @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    @property
    def outline(self) -> np.ndarray:
        """Four corners in the target's frame (4, 3) [m], clockwise in the image, from the upper left one."""
        own = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        return (own * [*self.size, 1.0]) @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    def draw(self, square_pixels: int) -> np.ndarray:
        """Draw the print (H, W) uint8, `square_pixels` along each side of a square, which are a multiple of 8."""
        return np.asarray(
            self.board.generateImage((square_pixels * self.columns, square_pixels * self.rows), marginSize=0)
        )


@dataclass(frozen=True, eq=False)
class Target:
    """Rigid body with printed faces.

    Parameters
    ----------
    name
        Name in files and messages.
    faces
        Faces, each with its own markers.
    """

    name: str
    faces: tuple[Face, ...]

    @property
    def outline(self) -> np.ndarray:
        """Corners of all faces in the target's frame (n, 3) [m]."""
        return np.concatenate([face.outline for face in self.faces])


def is_seen_from_front(T_camera_face: np.ndarray) -> bool:
    """Return True if a face at a pose (4, 4) turns its print to the camera."""
    return bool(T_camera_face[:3, 2] @ T_camera_face[:3, 3] > 0.0)


CUBE_SQUARE = 8e-3  # Side of a square of the cube's faces [m].
BORDER_WIDTH = 4e-3  # Width of the white border round the squares of a face [m].
TIP_DISTANCE = 150e-3  # Distance of the tool's tip from the centre of its cube along the shaft [m].


@lru_cache
def build_tool_cube() -> Target:
    """Build a cube of three faces, 48 mm wide with borders; its frame has its origin in the centre, z along the shaft.

    The faces look along +x, +y and +z, so that a camera before the corner between them sees all three. The tool's tip
    is nominally at (0, 0, -150) mm.
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
    """Build a plate of 60 mm to be fixed next to the craniotomy; its frame is the face's own, z into the plate."""
    return Target("patient", (Face(5, 5, 12e-3, 36, np.eye(4)),))


@lru_cache
def build_calibration_board() -> Target:
    """Build a board of 9 x 7 squares of 24 mm, which fits A4; its frame is the face's own."""
    return Target("board", (Face(9, 7, 24e-3, 48, np.eye(4)),))


def list_targets() -> tuple[Target, Target, Target]:
    """Build the tool's cube, the patient's reference and the calibration board."""
    return build_tool_cube(), build_patient_reference(), build_calibration_board()


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Detected corners of one target.

    Parameters
    ----------
    points
        Points (n, 3) [m] in the target's frame.
    pixels
        Detected positions (n, 2).
    face
        Number of the face (n,) of each corner.
    """

    points: np.ndarray
    pixels: np.ndarray
    face: np.ndarray


@dataclass(frozen=True, eq=False)
class Detector:
    """Detector of targets' corners. Markers are detected once; each face's corners follow from its own.

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
        """Detect corners in an image (H, W) uint8, by the target's name; targets without visible corners are left out.

        Only targets of these `names` are detected; without names, all.
        """
        corners, known = _detect_markers(self._thorough, self.targets, np.ascontiguousarray(grey))
        wanted = [target for target in self.targets if not names or target.name in names]
        found = {target.name: self._interpolate_corners(target, grey, corners, known) for target in wanted}
        return {name: each for name, each in found.items() if len(each.points)}

    def detect_in_window(self, target: Target, grey: np.ndarray, window: Window) -> DetectedCorners | None:
        """Detect corners of one target in a window of an image (H, W) uint8, if any: faster, with one threshold."""
        part = np.ascontiguousarray(grey[window])
        if min(part.shape) < MIN_PART_SIDE:
            return None
        found = self._interpolate_corners(target, part, *_detect_markers(self._quick[target.name], [target], part))
        return replace(found, pixels=found.pixels + [window[1].start, window[0].start]) if len(found.points) else None

    def _interpolate_corners(
        self, target: Target, grey: np.ndarray, markers: np.ndarray, ids: np.ndarray
    ) -> DetectedCorners:
        """Interpolate the chessboards' corners of a target between its markers, (n, 1, 4, 2) of numbers (n,)."""
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
    """Return rows and columns round points (n, 3) [m] in a camera's frame; None if they are out of view.

    The margin is `relative_margin` x their extent, at least `min_margin` pixels. The camera is at the world's origin.
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
    """Detect corners (n, 1, 4, 2) [pixel] of markers in an image, and their numbers (n,)."""
    corners, ids, _ = detector.detectMarkers(grey)
    which = np.zeros(0, int) if ids is None else np.asarray(ids, int).reshape(-1)
    return np.asarray(corners, np.float32).reshape(-1, 1, 4, 2), _list_numbers(targets)[which]


def _list_numbers(targets: Sequence[Target]) -> np.ndarray:
    """Return the marker numbers (n,) of targets, sorted."""
    return np.sort(np.concatenate([face.ids for target in targets for face in target.faces]))


def _build_dictionary(targets: Sequence[Target]) -> cv2.aruco.Dictionary:
    """Return a dictionary of the targets' markers alone: comparing candidates with each takes most of the time."""
    whole = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
    return cv2.aruco.Dictionary(whole.bytesList[_list_numbers(targets)], whole.markerSize)


def _build_parameters(least: int, most: int) -> cv2.aruco.DetectorParameters:
    """Build detector parameters with threshold windows of two widths [pixel], or of one."""
    found = cv2.aruco.DetectorParameters()
    found.adaptiveThreshWinSizeMin, found.adaptiveThreshWinSizeMax = least, most
    found.adaptiveThreshWinSizeStep = max(most - least, 1)
    return found

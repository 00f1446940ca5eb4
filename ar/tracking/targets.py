"""Printed targets that a camera sees: the tool's cube, the patient's reference, and the board that calibrates cameras.

Every face is a ChArUco board of odd by odd squares, whose corners are those of a chessboard. OpenCV finds them to a
tenth of a pixel. A marker's own corners are off by a fifth, always inwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

MARKERS = cv2.aruco.DICT_4X4_250
# Of a square, what its marker takes.
MARKER = 0.75


@dataclass(frozen=True, eq=False)
class Face:
    """One printed face: a chessboard with a marker in every second square.

    Parameters
    ----------
    columns, rows
        Squares, both odd.
    square
        Side of one [m].
    first
        Number of its first marker in the dictionary; the others follow.
    T_target_face
        (4, 4): the face's frame has its origin in the upper left corner, x to the right, y down, z into the target.
    """

    columns: int
    rows: int
    square: float
    first: int
    T_target_face: np.ndarray

    @property
    def ids(self) -> np.ndarray:
        """Numbers of its markers (n,)."""
        return self.first + np.arange(self.columns * self.rows // 2)

    @property
    def size(self) -> np.ndarray:
        """Width and height (2,) [m]."""
        return self.square * np.array([self.columns, self.rows])

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """As OpenCV has it, in metres."""
        dictionary = cv2.aruco.getPredefinedDictionary(MARKERS)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, MARKER * self.square, dictionary, self.ids
        )

    @cached_property
    def corners(self) -> np.ndarray:
        """Inner corners of the chessboard in the target's frame (n, 3) [m], in OpenCV's order."""
        own = np.asarray(self.board.getChessboardCorners(), np.float64).reshape(-1, 3)
        return own @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    @property
    def outline(self) -> np.ndarray:
        """Its four corners in the target's frame (4, 3) [m], clockwise as it is seen, from the upper left one."""
        own = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        return (own * [*self.size, 1.0]) @ self.T_target_face[:3, :3].T + self.T_target_face[:3, 3]

    def picture(self, pixels: int) -> np.ndarray:
        """What is printed (H, W) uint8, `pixels` along each side of a square, which are a multiple of 8."""
        return np.asarray(self.board.generateImage((pixels * self.columns, pixels * self.rows), marginSize=0))


@dataclass(frozen=True, eq=False)
class Target:
    """A rigid body with printed faces.

    Parameters
    ----------
    name
        As it is called in files and messages.
    faces
        Each with markers of its own.
    """

    name: str
    faces: tuple[Face, ...]

    @property
    def outline(self) -> np.ndarray:
        """The corners of all faces in the target's frame (n, 3) [m]."""
        return np.concatenate([face.outline for face in self.faces])


def seen_from_front(T_camera_face: np.ndarray) -> bool:
    """Whether a face at a pose (4, 4) turns its print to the camera."""
    return bool(T_camera_face[:3, 2] @ T_camera_face[:3, 3] > 0.0)


# Squares of the cube's faces, and how far the white border goes round them [m].
CUBE_SQUARE, BORDER = 8e-3, 4e-3
# The tool's tip is so far below the middle of its cube [m], along the shaft.
TIP = 150e-3


@lru_cache
def tool_cube() -> Target:
    """A cube of three faces, 48 mm wide with their borders; its frame has its origin in the middle, z along the shaft.

    The faces look along +x, +y and +z, so that a camera before the corner between them sees all three. The tool's tip
    is nominally at (0, 0, -150) mm.
    """
    half, wide = 2.5 * CUBE_SQUARE, 2.5 * CUBE_SQUARE + BORDER
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
def patient_reference() -> Target:
    """A plate of 60 mm that is fixed beside the opening; its frame is the face's own, z into the plate."""
    return Target("patient", (Face(5, 5, 12e-3, 36, np.eye(4)),))


@lru_cache
def calibration_board() -> Target:
    """A board of 9 x 7 squares of 24 mm, which fits A4; its frame is the face's own."""
    return Target("board", (Face(9, 7, 24e-3, 48, np.eye(4)),))


def all_targets() -> tuple[Target, Target, Target]:
    """The tool's cube, the patient's reference and the calibration board."""
    return tool_cube(), patient_reference(), calibration_board()

"""Corners of printed targets in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from ..optics.camera import Camera
from .targets import MARKERS, Target

Window = tuple[slice, slice]
"""Rows and columns of a picture, with start and stop."""
# Widths [pixel] of the windows that decide what is black.
THOROUGH, QUICK = (5, 25), (15, 15)
# Pixels along a side below which no marker can be.
SMALLEST = 16


@dataclass(frozen=True, eq=False)
class Corners:
    """What is seen of one target.

    Parameters
    ----------
    points
        In the target's frame (n, 3) [m].
    pixels
        Where the picture has them (n, 2).
    face
        Number of the face (n,) that each is on.
    """

    points: np.ndarray
    pixels: np.ndarray
    face: np.ndarray


@dataclass(frozen=True, eq=False)
class Detector:
    """Finds the corners of targets. Markers are looked for once; each face's corners follow from its own.

    Parameters
    ----------
    targets
        Of different names, and with different markers.
    """

    targets: Sequence[Target]
    _thorough: cv2.aruco.ArucoDetector = field(init=False, repr=False)
    _quick: dict[str, cv2.aruco.ArucoDetector] = field(init=False, repr=False)
    _boards: dict[tuple[str, int], cv2.aruco.CharucoDetector] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        quick = {target.name: cv2.aruco.ArucoDetector(_codes([target]), _parameters(*QUICK)) for target in self.targets}
        thorough = cv2.aruco.ArucoDetector(_codes(self.targets), _parameters(*THOROUGH))
        boards = {
            (target.name, number): cv2.aruco.CharucoDetector(face.board)
            for target in self.targets
            for number, face in enumerate(target.faces)
        }
        object.__setattr__(self, "_thorough", thorough)
        object.__setattr__(self, "_quick", quick)
        object.__setattr__(self, "_boards", boards)

    def seen(self, grey: np.ndarray, names: Sequence[str] = ()) -> dict[str, Corners]:
        """Corners by the target's name in a picture (H, W) uint8; targets of which none is seen are left out.

        Of the targets those of the `names` are looked for; without any, all.
        """
        corners, known = _markers(self._thorough, self.targets, np.ascontiguousarray(grey))
        wanted = [target for target in self.targets if not names or target.name in names]
        found = {target.name: self._between(target, grey, corners, known) for target in wanted}
        return {name: each for name, each in found.items() if len(each.points)}

    def seen_in(self, target: Target, grey: np.ndarray, window: Window) -> Corners | None:
        """Corners of one target in a window of a picture (H, W) uint8, if there are any: faster, by one threshold."""
        part = np.ascontiguousarray(grey[window])
        if min(part.shape) < SMALLEST:
            return None
        found = self._between(target, part, *_markers(self._quick[target.name], [target], part))
        return replace(found, pixels=found.pixels + [window[1].start, window[0].start]) if len(found.points) else None

    def _between(self, target: Target, grey: np.ndarray, markers: np.ndarray, ids: np.ndarray) -> Corners:
        """The chessboards' corners of a target between its markers, (n, 1, 4, 2) of numbers (n,)."""
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
        return Corners(np.concatenate(points), np.concatenate(pixels), np.concatenate(on))


def window_round(camera: Camera, points: np.ndarray, share: float, least: float) -> Window | None:
    """Rows and columns round points (n, 3) [m] in a camera's frame; None: they are out of view.

    It goes beyond them by a `share` of what they cover, and by `least` pixels at least. The camera is at the world's
    origin.
    """
    pixels = camera.project(points)[0]
    pixels = pixels[~np.isnan(pixels).any(axis=1)]
    if not len(pixels):
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    wide, limits = np.maximum(share * (high - low), least), [camera.width, camera.height]
    left, top = np.clip(low - wide, 0, limits).astype(int).tolist()
    right, bottom = np.clip(high + wide + 1.0, 0, limits).astype(int).tolist()
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def _markers(
    detector: cv2.aruco.ArucoDetector, targets: Sequence[Target], grey: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 1, 4, 2) [pixel] of markers in a picture, and their numbers (n,)."""
    corners, ids, _ = detector.detectMarkers(grey)
    which = np.zeros(0, int) if ids is None else np.asarray(ids, int).reshape(-1)
    return np.asarray(corners, np.float32).reshape(-1, 1, 4, 2), _numbers(targets)[which]


def _numbers(targets: Sequence[Target]) -> np.ndarray:
    """Numbers of the markers of targets (n,), sorted."""
    return np.sort(np.concatenate([face.ids for target in targets for face in target.faces]))


def _codes(targets: Sequence[Target]) -> cv2.aruco.Dictionary:
    """The markers of targets alone: whatever looks like one is held against each, which takes most of the time."""
    whole = cv2.aruco.getPredefinedDictionary(MARKERS)
    return cv2.aruco.Dictionary(whole.bytesList[_numbers(targets)], whole.markerSize)


def _parameters(least: int, most: int) -> cv2.aruco.DetectorParameters:
    """Thresholds by windows of two widths [pixel], or of one."""
    found = cv2.aruco.DetectorParameters()
    found.adaptiveThreshWinSizeMin, found.adaptiveThreshWinSizeMax = least, most
    found.adaptiveThreshWinSizeStep = max(most - least, 1)
    return found

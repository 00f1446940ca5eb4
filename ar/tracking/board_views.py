"""The calibration board in pictures: where its corners are seen, how sharply, and which views say most together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from .targets import Detector, Face

# Corners that a view needs, and how many rows and columns of the board they stand in at least.
FEWEST_CORNERS, FEWEST_LINES = 8, 3
# Sharpness of a view that is left out, as a share of the median.
BLURRED = 0.6


@dataclass(frozen=True, eq=False)
class View:
    """The corners of the board that one picture shows.

    Parameters
    ----------
    name
        Of the picture.
    points
        (n, 3) on the board [m].
    pixels
        (n, 2) where they are seen.
    sharpness
        Steepest slope of its edges, as a share of their contrast [1/pixel].
    """

    name: str
    points: np.ndarray
    pixels: np.ndarray
    sharpness: float

    @cached_property
    def homography(self) -> np.ndarray:
        """(3, 3): pixels of places on the board [m], without regard of the lens; NaN where there is none."""
        centred = self.points[:, :2] - self.points[:, :2].mean(axis=0)
        found = cv2.findHomography(centred, self.pixels)[0]
        if found is None:
            return np.full((3, 3), np.nan)
        shift = np.eye(3)
        shift[:2, 2] = -self.points[:, :2].mean(axis=0)
        return found @ shift


def find_board(detector: Detector, name: str, grey: np.ndarray) -> View | None:
    """The board that a detector is for, in a picture (H, W) uint8.

    None where too few of its corners are seen, or all in one or two rows.
    """
    (board,) = detector.targets
    seen = detector.seen(grey).get(board.name)
    if seen is None or len(seen.points) < FEWEST_CORNERS:
        return None
    lines = np.rint(seen.points[:, :2] / board.faces[0].square)
    if min(len(np.unique(lines[:, axis])) for axis in (0, 1)) < FEWEST_LINES:
        return None
    view = View(name, seen.points, seen.pixels, _sharpness(grey, seen.pixels))
    return view if np.isfinite(view.homography).all() and np.linalg.matrix_rank(view.homography) == 3 else None


def _sharpness(grey: np.ndarray, pixels: np.ndarray) -> float:
    """Of the part of a picture that holds the pixels (n, 2): along columns or rows, whichever is less sharp."""
    low, high = np.floor(pixels.min(axis=0)).astype(int), np.ceil(pixels.max(axis=0)).astype(int) + 1
    part = grey[max(low[1], 0) : high[1], max(low[0], 0) : high[0]].astype(np.float32)
    dark, bright = np.percentile(part, [5.0, 95.0])
    slopes = [np.percentile(np.abs(np.diff(part, axis=axis)), 99.0) for axis in (0, 1)]
    return float(min(slopes) / max(bright - dark, 1.0))


def chosen(views: Sequence[View], face: Face, most: int) -> list[View]:
    """At most so many of the sharp views, each as unlike those before it as there is.

    Views are compared by where the board's outline is in the picture. Gonzalez (1985), "Clustering to minimize the
    maximum intercluster distance": the farthest view from all chosen ones comes next.
    """
    median = np.median([view.sharpness for view in views]) if views else 0.0
    sharp = [view for view in views if view.sharpness >= BLURRED * median]
    if len(sharp) <= most:
        return sharp
    outline = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * face.size
    places = np.array([cv2.perspectiveTransform(outline[:, None], view.homography).ravel() for view in sharp])
    first = int(np.argmax([len(view.pixels) for view in sharp]))
    order, far = [first], np.linalg.norm(places - places[first], axis=1)
    while len(order) < most:
        order.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(places - places[order[-1]], axis=1))
    return [sharp[index] for index in sorted(order)]


def directions(views: Sequence[View], width: int, height: int) -> float:
    """The largest angle [rad] between planes of the board in two views, by the lines in which they vanish.

    The focal length, which is not known yet, is taken as the longer side of the picture. Hartley and Zisserman (2004),
    "Multiple View Geometry", section 8.6: a plane's normal is K^T of its vanishing line.
    """
    middle = np.array(
        [[max(width, height), 0.0, 0.5 * width], [0.0, max(width, height), 0.5 * height], [0.0, 0.0, 1.0]]
    )
    lines = np.array([np.linalg.inv(view.homography)[2] for view in views])
    normals = lines @ middle
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)).max())


def covered(views: Sequence[View], width: int, height: int) -> float:
    """The share of a picture that lies between the corners of at least one view."""
    mask = np.zeros((height, width), np.uint8)
    for view in views:
        cv2.fillConvexPoly(mask, np.rint(cv2.convexHull(view.pixels.astype(np.float32))).astype(np.int32), (1,))
    return float(mask.mean())

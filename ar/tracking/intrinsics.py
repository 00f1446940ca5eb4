"""Camera intrinsics from views of the calibration board, with their covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from ..optics.calibration import Calibration
from ..optics.camera import Camera
from ..optics.lens import Lens
from .targets import Detector, Face


@dataclass(frozen=True)
class IntrinsicsSettings:
    """Settings of `find_board`, `choose_views` and `calibrate_intrinsics`."""

    min_corners: int = 8  # Minimum number of corners in a view.
    min_lines: int = 3  # Minimum number of corner rows and of corner columns of the board in a view.
    min_sharpness: float = 0.6  # Sharpness below which a view is left out, as a share of the median.
    min_views: int = 8  # Minimum number of views for a calibration.
    outlier_ratio: float = 3.0  # Ratio of a view's error to the median error above which it is left out.
    min_angle: float = np.radians(12.0)  # Smallest angle between the planes of the board [rad].
    max_focal_deviation: float = 0.02  # Largest relative standard deviation of the focal length.


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of the calibration board in one image.

    Parameters
    ----------
    name
        Name of the image.
    points
        Corners (n, 3) [m] in the board's frame.
    pixels
        Detected positions (n, 2) [pixel].
    sharpness
        Steepest grey-level slope at edges, relative to their contrast [1/pixel].
    """

    name: str
    points: np.ndarray
    pixels: np.ndarray
    sharpness: float

    @cached_property
    def homography(self) -> np.ndarray:
        """Homography (3, 3) from board positions [m] to pixels, without lens distortion; NaN if not found."""
        centred = self.points[:, :2] - self.points[:, :2].mean(axis=0)
        found = cv2.findHomography(centred, self.pixels)[0]
        if found is None:
            return np.full((3, 3), np.nan)
        shift = np.eye(3)
        shift[:2, 2] = -self.points[:, :2].mean(axis=0)
        return found @ shift


def find_board(
    detector: Detector, name: str, grey: np.ndarray, settings: IntrinsicsSettings = IntrinsicsSettings()
) -> BoardView | None:
    """Detect the detector's board in an image (H, W) uint8; return its corners as a view.

    None if too few corners are visible, or if they are in fewer than three rows or columns.
    """
    (board,) = detector.targets
    seen = detector.detect(grey).get(board.name)
    if seen is None or len(seen.points) < settings.min_corners:
        return None
    lines = np.rint(seen.points[:, :2] / board.faces[0].square)
    if min(len(np.unique(lines[:, axis])) for axis in (0, 1)) < settings.min_lines:
        return None
    view = BoardView(name, seen.points, seen.pixels, _compute_sharpness(grey, seen.pixels))
    return view if np.isfinite(view.homography).all() and np.linalg.matrix_rank(view.homography) == 3 else None


def _compute_sharpness(grey: np.ndarray, pixels: np.ndarray) -> float:
    """Compute the sharpness of the image part with the pixels (n, 2): the smaller value of rows and columns."""
    low, high = np.floor(pixels.min(axis=0)).astype(int), np.ceil(pixels.max(axis=0)).astype(int) + 1
    part = grey[max(low[1], 0) : high[1], max(low[0], 0) : high[0]].astype(np.float32)
    dark, bright = np.percentile(part, [5.0, 95.0])
    slopes = [np.percentile(np.abs(np.diff(part, axis=axis)), 99.0) for axis in (0, 1)]
    return float(min(slopes) / max(bright - dark, 1.0))


def choose_views(
    views: Sequence[BoardView], face: Face, max_views: int, settings: IntrinsicsSettings = IntrinsicsSettings()
) -> list[BoardView]:
    """Select at most `max_views` sharp views that differ as much as possible.

    Views are compared by the position of the board's outline in the image. Gonzalez (1985), "Clustering to minimize the
    maximum intercluster distance": the view farthest from all chosen views is chosen next.
    """
    median = np.median([view.sharpness for view in views]) if views else 0.0
    sharp = [view for view in views if view.sharpness >= settings.min_sharpness * median]
    if len(sharp) <= max_views:
        return sharp
    outline = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * face.size
    places = np.array([cv2.perspectiveTransform(outline[:, None], view.homography).ravel() for view in sharp])
    first = int(np.argmax([len(view.pixels) for view in sharp]))
    order, far = [first], np.linalg.norm(places - places[first], axis=1)
    while len(order) < max_views:
        order.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(places - places[order[-1]], axis=1))
    return [sharp[index] for index in sorted(order)]


def measure_tilt_range(views: Sequence[BoardView], width: int, height: int) -> float:
    """Compute the largest angle [rad] between the board's planes in two views, from their vanishing lines.

    The focal length, which is not yet known, is approximated by the image's longer side. Hartley and Zisserman (2004),
    "Multiple View Geometry", section 8.6: a plane's normal is K^T times its vanishing line.
    """
    middle = np.array(
        [[max(width, height), 0.0, 0.5 * width], [0.0, max(width, height), 0.5 * height], [0.0, 0.0, 1.0]]
    )
    lines = np.array([np.linalg.inv(view.homography)[2] for view in views])
    normals = lines @ middle
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)).max())


def measure_covered_share(views: Sequence[BoardView], width: int, height: int) -> float:
    """Compute the share of the image area inside the convex hull of the corners of at least one view."""
    mask = np.zeros((height, width), np.uint8)
    for view in views:
        cv2.fillConvexPoly(mask, np.rint(cv2.convexHull(view.pixels.astype(np.float32))).astype(np.int32), (1,))
    return float(mask.mean())


POSE_COLUMNS = slice(0, 6)  # Columns of OpenCV's derivatives: rotation and translation of a pose.
# Columns of OpenCV's derivatives: focal lengths, principal point and five coefficients of the lens.
INTRINSIC_COLUMNS = slice(6, 15)
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Parameters in the order of the covariance; focal lengths and principal point are in pixels."""
# Remedy in error messages.
REMEDY = "Tilt the board by 20 to 45 degrees to all sides, near and far, and also in the image's corners."


def compute_calibration_error(
    camera: Camera, T_camera_target: np.ndarray, corners: np.ndarray, point: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Propagate a calibration's covariance to a point of a target: covariance (3, 3) [m^2] in the camera's frame.

    The fitted pose compensates most of a calibration error, as the same camera sees target and point. The remaining
    error is computed from derivatives of the projection, and only across the line of sight, where it is observable.

    Parameters
    ----------
    camera
        Camera that took the image; its pose is ignored.
    T_camera_target
        Pose (4, 4) [m], fitted to the corners with this camera.
    corners, point
        Corners (n, 3) and point (3,) [m] in the target's frame.
    covariance
        Covariance (9, 9) of the camera's `PARAMETERS`.
    """
    distortion = np.pad(np.ravel(camera.distortion), (0, 5))[: max(5, np.size(camera.distortion))]
    turn = cv2.Rodrigues(T_camera_target[:3, :3])[0]
    slopes = [
        cv2.projectPoints(points, turn, T_camera_target[:3, 3], camera.K, distortion)[1]
        for points in (corners, point[None])
    ]
    seen, there = slopes
    taken_up = np.linalg.lstsq(seen[:, POSE_COLUMNS], seen[:, INTRINSIC_COLUMNS], rcond=None)[0]
    left = there[:, INTRINSIC_COLUMNS] - there[:, POSE_COLUMNS] @ taken_up
    across = np.linalg.pinv(there[:, 3:6]) @ left
    return across @ covariance @ across.T


def to_parameters(calibration: Calibration) -> np.ndarray:
    """Return the values (9,) of a calibration, in the order of `PARAMETERS`."""
    return np.array([*calibration.focal, *calibration.principal, *calibration.lens.coefficients[:5]])


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Calibrated intrinsics of a camera, with their errors.

    Parameters
    ----------
    calibration
        Calibration of the camera.
    covariance
        Covariance (9, 9) of `PARAMETERS`.
    rms
        Root mean square distance [pixel] between detected and projected corners, over all views used.
    used_views, excluded_views
        Names of the used views, and of those excluded for large errors.
    covered_share
        Share of the image that is inside the corners of at least one view.
    """

    calibration: Calibration
    covariance: np.ndarray
    rms: float
    used_views: tuple[str, ...]
    excluded_views: tuple[str, ...]
    covered_share: float

    @property
    def parameters(self) -> np.ndarray:
        """Values (9,) of `PARAMETERS`."""
        return to_parameters(self.calibration)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (9,) of `PARAMETERS`."""
        return np.sqrt(np.diag(self.covariance))


def calibrate_intrinsics(
    views: Sequence[BoardView], width: int, height: int, name: str = "",
    settings: IntrinsicsSettings = IntrinsicsSettings(),
) -> Intrinsics:  # fmt: skip
    """Calibrate a camera from views of the board in images of `width` x `height` pixels.

    The method is Zhang (2000), "A flexible new technique for camera calibration", by OpenCV, with five coefficients of
    a Brown-Conrady lens. Views that fit much worse than the others are excluded, and the calibration is repeated.

    Raises
    ------
    ValueError
        There are too few views, all are from one direction, or they do not determine the camera.
    """
    kept, excluded = list(views), []
    while True:
        _check_views(kept, len(excluded), width, height, settings)
        K, coefficients, poses, errors = _solve_views(kept, width, height)
        bad = errors > settings.outlier_ratio * np.median(errors)
        if not bad.any():
            break
        excluded += [view.name for view, worse in zip(kept, bad, strict=True) if worse]
        kept = [view for view, worse in zip(kept, bad, strict=True) if not worse]
    calibration = Calibration((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), width, height, Lens(*coefficients.tolist()), name)
    try:
        covariance, rms = compute_intrinsics_covariance(calibration, kept, poses)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"the views determine no camera. {REMEDY}") from error
    used, covered = tuple(view.name for view in kept), measure_covered_share(kept, width, height)
    found = Intrinsics(calibration, covariance, rms, used, tuple(excluded), covered)
    unsure = found.deviations[:2] / calibration.focal
    if not unsure.max() <= settings.max_focal_deviation:
        raise ValueError(f"the views leave the focal length unknown to {100.0 * unsure.max():.0f} %. {REMEDY}")
    return found


def _check_views(
    views: Sequence[BoardView], excluded_count: int, width: int, height: int, settings: IntrinsicsSettings
) -> None:
    """Raise ValueError if the views do not determine a camera."""
    if len(views) < settings.min_views:
        without = f", and {excluded_count} more fit badly" if excluded_count else ""
        raise ValueError(
            f"{len(views)} sharp views show the board{without}, but {settings.min_views} are needed: take 20 images or "
            "more, in good light and without motion."
        )
    angle = measure_tilt_range(views, width, height)
    if angle < settings.min_angle:
        raise ValueError(
            f"the board is seen from one direction in all {len(views)} views, to {np.degrees(angle):.0f} degrees. "
            f"{REMEDY}"
        )


def _solve_views(
    views: Sequence[BoardView], width: int, height: int
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Compute K (3, 3), five lens coefficients, each view's pose (rotation vector, translation), rms errors [pixel]."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        guess = cv2.initCameraMatrix2D(points, pixels, (width, height))
        _, K, coefficients, turns, shifts, _, _, errors = cv2.calibrateCameraExtended(
            points, pixels, (width, height), guess, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
        )
    except cv2.error as error:
        raise ValueError(f"the views determine no camera. {REMEDY}") from error
    poses = [(np.ravel(turn), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)]
    if not (np.isfinite(K).all() and np.isfinite(coefficients).all() and np.isfinite(errors).all()):
        raise ValueError(f"the views determine no camera. {REMEDY}")
    return np.asarray(K), np.ravel(coefficients)[:5], poses, np.ravel(errors)


def compute_intrinsics_covariance(
    calibration: Calibration, views: Sequence[BoardView], poses: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, float]:
    """Compute the covariance (9, 9) of `PARAMETERS` at the least-squares solution, and the rms residual [pixel].

    The normal equations have nine parameters of the camera and six of each view. A Schur complement eliminates the
    views; A and B are the derivatives of pixels by the parameters of the camera and of the view:

        S = sum over views of A^T A - A^T B (B^T B)^-1 B^T A.

    The covariance is s^2 S^-1, with s^2 the sum of squares over the degrees of freedom. Triggs et al. (2000), "Bundle
    adjustment: a modern synthesis", section 6.1.
    """
    normal, squares, count = np.zeros((9, 9)), 0.0, 0
    for view, (turn, shift) in zip(views, poses, strict=True):
        pixels, slopes = cv2.projectPoints(view.points, turn, shift, calibration.K, calibration.lens.coefficients[:5])
        slopes = np.asarray(slopes, np.float64)
        inside, outside = slopes[:, 6:15], slopes[:, :6]
        basis = np.linalg.qr(outside)[0]
        rest = inside - basis @ (basis.T @ inside)
        normal += rest.T @ rest
        squares += float(np.square(pixels.reshape(-1, 2) - view.pixels).sum())
        count += len(view.pixels)
    scale = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    freedom = 2 * count - 9 - 6 * len(views)
    return squares / freedom * 0.5 * (inverse + inverse.T), float(np.sqrt(squares / count))

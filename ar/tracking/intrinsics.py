"""Intrinsics of a camera from views of the calibration board, and how surely they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..optics.calibration import Calibration
from ..optics.camera import Camera
from ..optics.lens import Lens
from .board_views import View, covered, directions

# Columns of OpenCV's derivatives: turn and shift of a pose; focal lengths, principal point and five of the lens.
POSE, INTRINSIC = slice(0, 6), slice(6, 15)
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""In the order of the covariance; focal lengths and principal point [pixel]."""
FEWEST_VIEWS = 8
# A view whose error is so many times the median's is left out.
OUTLIER = 3.0
# Planes must differ by this angle [rad], and the focal length be known to this share of it.
SMALLEST_ANGLE, UNSURE = np.radians(12.0), 0.02
TILT = "Tilt the board by 20 to 45 degrees to all sides, near and far, and also in the picture's corners."


def calibration_error(
    camera: Camera, T_camera_target: np.ndarray, corners: np.ndarray, place: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """The covariance (3, 3) [m^2], in the camera's frame, of a place of a target, by that of the camera's calibration.

    The pose takes up most of an error of the calibration, for target and place are seen by the same camera. What is
    left is found by the derivatives of the projection: as far as it is seen, across the line of sight.

    Parameters
    ----------
    camera
        As it took the picture; where it stands is of no account.
    T_camera_target
        (4, 4) [m]: fitted to the corners by this camera.
    corners, place
        (n, 3) and (3,) [m] in the target's frame.
    covariance
        (9, 9) of `ar.tracking.intrinsics.PARAMETERS`.
    """
    distortion = np.pad(np.ravel(camera.distortion), (0, 5))[: max(5, np.size(camera.distortion))]
    turn = cv2.Rodrigues(T_camera_target[:3, :3])[0]
    slopes = [
        cv2.projectPoints(points, turn, T_camera_target[:3, 3], camera.K, distortion)[1]
        for points in (corners, place[None])
    ]
    seen, there = slopes
    taken_up = np.linalg.lstsq(seen[:, POSE], seen[:, INTRINSIC], rcond=None)[0]
    left = there[:, INTRINSIC] - there[:, POSE] @ taken_up
    across = np.linalg.pinv(there[:, 3:6]) @ left
    return across @ covariance @ across.T


def values_of(calibration: Calibration) -> np.ndarray:
    """A calibration's values (9,) of `PARAMETERS`."""
    return np.array([*calibration.focal, *calibration.principal, *calibration.lens.coefficients[:5]])


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A calibrated camera.

    Parameters
    ----------
    calibration
        The camera.
    covariance
        (9, 9) of `PARAMETERS`.
    rms
        Root mean square distance [pixel] between corners as seen and as projected, over those of all views used.
    used, left_out
        Names of views: those that count, and those whose errors were too large.
    covered
        The share of the picture that lies between corners of a view.
    """

    calibration: Calibration
    covariance: np.ndarray
    rms: float
    used: tuple[str, ...]
    left_out: tuple[str, ...]
    covered: float

    @property
    def values(self) -> np.ndarray:
        """(9,) of `PARAMETERS`."""
        return values_of(self.calibration)

    @property
    def deviations(self) -> np.ndarray:
        """(9,) standard deviations of `PARAMETERS`."""
        return np.sqrt(np.diag(self.covariance))


def calibrated(views: Sequence[View], width: int, height: int, name: str = "") -> Intrinsics:
    """The camera that saw these views in pictures of `width` x `height`.

    Zhang (2000), "A flexible new technique for camera calibration", by OpenCV; a lens of Brown and Conrady with five
    coefficients. Views that fit much worse than the others are left out, and the rest is calibrated anew.

    Raises
    ------
    ValueError
        Too few views, all from one direction, or views that determine no camera.
    """
    kept, left_out = list(views), []
    while True:
        _demand_views(kept, len(left_out), width, height)
        K, coefficients, poses, errors = _solved(kept, width, height)
        bad = errors > OUTLIER * np.median(errors)
        if not bad.any():
            break
        left_out += [view.name for view, worse in zip(kept, bad, strict=True) if worse]
        kept = [view for view, worse in zip(kept, bad, strict=True) if not worse]
    calibration = Calibration((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), width, height, Lens(*coefficients.tolist()), name)
    try:
        covariance, rms = covariance_of(calibration, kept, poses)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"the views determine no camera. {TILT}") from error
    found = Intrinsics(
        calibration, covariance, rms, tuple(v.name for v in kept), tuple(left_out), covered(kept, width, height)
    )
    unsure = found.deviations[:2] / calibration.focal
    if not unsure.max() <= UNSURE:
        raise ValueError(f"the views leave the focal length unknown to {100.0 * unsure.max():.0f} %. {TILT}")
    return found


def _demand_views(views: Sequence[View], left_out: int, width: int, height: int) -> None:
    """Refuse what determines no camera."""
    if len(views) < FEWEST_VIEWS:
        without = f", and {left_out} more fit badly" if left_out else ""
        raise ValueError(
            f"{len(views)} sharp views show the board{without}, but {FEWEST_VIEWS} are needed: take 20 pictures or "
            "more, in good light and without motion."
        )
    angle = directions(views, width, height)
    if angle < SMALLEST_ANGLE:
        raise ValueError(
            f"the board is seen from one direction in all {len(views)} views, to {np.degrees(angle):.0f} degrees. "
            f"{TILT}"
        )


def _solved(
    views: Sequence[View], width: int, height: int
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """K (3, 3), five coefficients, each view's rotation vector and translation (3,), and its rms error [pixel] (n,)."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        guess = cv2.initCameraMatrix2D(points, pixels, (width, height))
        _, K, coefficients, turns, shifts, _, _, errors = cv2.calibrateCameraExtended(
            points, pixels, (width, height), guess, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
        )
    except cv2.error as error:
        raise ValueError(f"the views determine no camera. {TILT}") from error
    poses = [(np.ravel(turn), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)]
    if not (np.isfinite(K).all() and np.isfinite(coefficients).all() and np.isfinite(errors).all()):
        raise ValueError(f"the views determine no camera. {TILT}")
    return np.asarray(K), np.ravel(coefficients)[:5], poses, np.ravel(errors)


def covariance_of(
    calibration: Calibration, views: Sequence[View], poses: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, float]:
    """Covariance (9, 9) of `PARAMETERS` at the least-squares solution, and the rms distance [pixel].

    The normal equations hold nine parameters of the camera and six of each view. A Schur complement eliminates those of
    the views, with A and B the pixels' slopes by the camera's parameters and by the view's:

        S = sum over views of A^T A - A^T B (B^T B)^-1 B^T A.

    The covariance is s^2 S^-1, with s^2 the sum of squares over the degrees of freedom. Triggs et al. (2000),
    "Bundle adjustment: a modern synthesis", section 6.1.
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

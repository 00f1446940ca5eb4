"""Cameras: projection of world points into an image, stereo pairs, and rolling shutters.

OpenCV's convention: the camera frame has x right, y down, z forward; a pixel (u, v) = (column, row) has whole numbers
at its centre, so the image spans -0.5 .. width - 0.5. World points are in metres (in this project RAS).

A rolling shutter exposes the rows one after the other, so a moving camera has another pose for each row. The time of an
image is that of its middle row; row times are relative to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from .lens import Lens, to_normalised, to_pixels, undistort_pixels


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera, optionally with lens distortion.

    Parameters
    ----------
    K
        Intrinsic matrix (3, 3) [pixel]: (u w, v w, w) = K x_camera.
    T_camera_world
        Rigid transform (4, 4): x_camera = T_camera_world x_world [m].
    width, height
        Size of the image [pixel].
    lens
        Lens distortion; None, or a lens with all coefficients 0: no distortion.

    Raises
    ------
    ValueError
        A shape is wrong, a number is not finite, a focal length is not positive, or the transform is not rigid.

    Examples
    --------
    >>> from ar import Camera
    >>> K = np.array([[1000.0, 0.0, 319.5], [0.0, 1000.0, 239.5], [0.0, 0.0, 1.0]])
    >>> camera = Camera(K, np.eye(4), width=640, height=480)  # at the origin, along z
    >>> camera.project(np.array([0.01, 0.0, 0.2]))[0].round(1).tolist()  # [pixel]
    [369.5, 239.5]
    """

    K: np.ndarray
    T_camera_world: np.ndarray
    width: int
    height: int
    lens: Lens | None = None

    def __post_init__(self) -> None:
        K, T = np.asarray(self.K, np.float64), np.asarray(self.T_camera_world, np.float64)
        if K.shape != (3, 3) or T.shape != (4, 4) or not (np.isfinite(K).all() and np.isfinite(T).all()):
            raise ValueError(f"a camera takes finite K (3, 3) and T_camera_world (4, 4), not {K.shape} and {T.shape}.")
        if K[0, 0] <= 0.0 or K[1, 1] <= 0.0 or K[1, 0] != 0.0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
            raise ValueError("K must be upper triangular with positive focal lengths and last row (0, 0, 1).")
        R = T[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0:
            raise ValueError("T_camera_world must be a rotation and a translation.")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"an image of {self.width} x {self.height} pixels is empty: both must be at least 1.")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "T_camera_world", T)
        if self.lens is not None and not self.lens.coefficients.any():
            object.__setattr__(self, "lens", None)

    @property
    def centre(self) -> np.ndarray:
        """Position (3,) [m] of the camera in the world."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    @property
    def distortion(self) -> np.ndarray:
        """Lens coefficients (8,) in OpenCV's order; zeros without a lens."""
        return np.zeros(8) if self.lens is None else self.lens.coefficients

    @property
    def vertical_fov(self) -> float:
        """Angle [rad] between upper and lower image border; exact without lens and with central principal point."""
        return float(2.0 * np.arctan(0.5 * self.height / self.K[1, 1]))

    def to_camera_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform world points (..., 3) [m] to the camera frame (..., 3) [m]."""
        return points @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (..., 3) [m] to pixels (..., 2), and compute their depths (...) [m].

        Pixels are NaN for depth <= 0 (behind the camera), and beyond the reach of the lens (`Lens.reach`).
        """
        in_camera = self.to_camera_frame(np.asarray(points, np.float64))
        if self.lens is not None:
            depth = in_camera[..., 2]
            places = in_camera[..., :2] / np.where(depth > 0.0, depth, np.nan)[..., None]
            return to_pixels(self.K, self.lens.distort(places)), depth
        homogeneous = in_camera @ self.K.T
        depth = homogeneous[..., 2]
        return homogeneous[..., :2] / np.where(depth > 0.0, depth, np.nan)[..., None], depth

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Compute the world points (..., 3) [m] at pixels (..., 2) and `depth` (...) [m], which is z, not range.

        NaN at pixels to which the lens projects no point.
        """
        if self.lens is not None:
            pixels = to_pixels(self.K, self.lens.undistort(to_normalised(self.K, np.asarray(pixels, np.float64))))
        homogeneous = np.concatenate([pixels, np.ones((*np.shape(pixels)[:-1], 1))], axis=-1)
        in_camera = homogeneous @ np.linalg.inv(self.K).T * np.asarray(depth)[..., None]
        return (in_camera - self.T_camera_world[:3, 3]) @ self.T_camera_world[:3, :3]

    @cached_property
    def straight(self) -> np.ndarray:
        """Undistorted position (H, W, 2) [pixel] of each pixel; NaN where the lens projects no point to a pixel."""
        if self.lens is None:
            rows, columns = np.mgrid[: self.height, : self.width].astype(np.float64)
            return np.stack([columns, rows], axis=-1)
        return undistort_pixels(self.lens, tuple(self.K.ravel().tolist()), self.width, self.height)

    def perturb(self, degrees: float, axis: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> Camera:
        """Return the camera with the world rotated by `degrees` about the camera's centre.

        The rotation is right-handed about `axis` in the camera frame; about y (default), the scene moves to the right.
        """
        direction = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(np.radians(degrees) * direction)[0]
        return replace(self, T_camera_world=turn @ self.T_camera_world)

    def move(self, shift: np.ndarray) -> Camera:
        """Return the camera moved by `shift` (3,) [m] in its own frame: right, down, forward."""
        T = self.T_camera_world.copy()
        T[:3, 3] -= shift
        return replace(self, T_camera_world=T)

    def zoom(self, factor: float) -> Camera:
        """Return the camera with its focal lengths multiplied by `factor`; principal point and lens are unchanged.

        Raises
        ------
        ValueError
            The factor is not a finite number above 0.
        """
        if not 0.0 < factor < np.inf:
            raise ValueError(f"a camera cannot zoom by {factor}: give a number above 0.")
        K = self.K.copy()
        K[:2, :2] *= factor
        return replace(self, K=K)

    def refocus(self, focal_length: float, before: float, now: float) -> Camera:
        """Return the camera after a change of the focus distance, which changes the magnification.

        A thin lens of focal length f forms the image of an object at distance d at f d / (d - f) behind the lens.

        Parameters
        ----------
        focal_length
            Focal length of the lens [m].
        before, now
            Focus distances [m]: during the calibration, and for the returned camera.

        Raises
        ------
        ValueError
            The focal length is <= 0, or a distance is <= the focal length.
        """
        if not 0.0 < focal_length < min(before, now) < np.inf:
            raise ValueError(
                f"a lens of {focal_length:g} m forms no image of an object {min(before, now):g} m away: focus farther."
            )
        behind = [distance / (distance - focal_length) for distance in (now, before)]
        return self.zoom(behind[0] / behind[1])

    def scale(self, factor: float) -> Camera:
        """Return the camera with the same view and `factor` times as many pixels along each side."""
        width, height = round(self.width * factor), round(self.height * factor)
        resize = np.array(
            [
                [width / self.width, 0.0, 0.5 * width / self.width - 0.5],
                [0.0, height / self.height, 0.5 * height / self.height - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )
        return replace(self, K=resize @ self.K, width=width, height=height)

    def crop_to(self, rows: slice, columns: slice) -> Camera:
        """Return the camera of the image part `[rows, columns]`; both slices have start and stop."""
        shift = np.zeros((3, 3))
        shift[:2, 2] = columns.start, rows.start
        part = replace(self, K=self.K - shift, width=columns.stop - columns.start, height=rows.stop - rows.start)
        if self.lens is not None:  # a copy is faster than computing it again
            part.__dict__["straight"] = self.straight[rows, columns] - shift[:2, 2]
        return part

    def pad(self, aspect: float) -> Camera:
        """Return the camera of the smallest canvas with width / height = `aspect` round the image, which is centred."""
        width = max(self.width, round(self.height * aspect))
        height = max(self.height, round(self.width / aspect))
        shift = np.zeros((3, 3))
        shift[:2, 2] = (width - self.width) // 2, (height - self.height) // 2
        return replace(self, K=self.K + shift, width=width, height=height)

    moved, zoomed, scaled, padded = move, zoom, scale, pad  # Former names, for one release.


def look_at(
    eye: np.ndarray, target: np.ndarray, up: np.ndarray, vertical_fov: float = np.radians(35.0), width: int = 640,
    height: int = 480,
) -> Camera:  # fmt: skip
    """Build a camera at `eye` (3,) [m] that looks at `target` (3,) [m]; `up` (3,) points upwards in the image.

    `vertical_fov` is in radians. Pixels are square, and the principal point is central. Raises ValueError if eye and
    target coincide, or if `up` is along the line of sight.

    Examples
    --------
    >>> from ar import look_at
    >>> camera = look_at(eye=np.array([0.0, 0.0, 0.3]), target=np.zeros(3), up=np.array([0.0, 1.0, 0.0]))
    >>> camera.project(np.zeros(3))[0].round(1).tolist()  # [pixel]
    [319.5, 239.5]
    """
    forward = np.asarray(target, np.float64) - eye
    right = np.cross(forward, up)
    if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise ValueError("eye, target and up leave the view undefined: move the eye off the target or turn up.")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = right, np.cross(forward, right), forward
    T[:3, 3] = -T[:3, :3] @ eye
    focal = 0.5 * height / np.tan(0.5 * vertical_fov)
    K = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Camera(K, T, width, height)


def project_cv2(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Project world points (N, 3) [m] to pixels (N, 2) by `cv2.projectPoints`, as a reference for `Camera.project`."""
    rotation = cv2.Rodrigues(camera.T_camera_world[:3, :3])[0]
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 1, 3)
    pixels, _ = cv2.projectPoints(points, rotation, camera.T_camera_world[:3, 3], camera.K, camera.distortion)
    return pixels.reshape(-1, 2)


BASELINE = 24e-3
"""Distance between the two optical paths of an operating microscope [m]."""


def build_stereo_pair(
    camera: Camera, baseline: float = BASELINE, working_distance: float | None = None
) -> tuple[Camera, Camera]:
    """Build the left and right cameras of a central camera, `baseline` [m] apart along its image rows.

    Parameters
    ----------
    working_distance
        Distance [m] at which the optical axes meet; None: the axes are parallel, and rows of both images correspond.

    Raises
    ------
    ValueError
        The baseline or the distance is not a finite number above 0.
    """
    if not 0.0 < baseline < np.inf or (working_distance is not None and not 0.0 < working_distance < np.inf):
        raise ValueError(f"a baseline of {baseline} m, a distance of {working_distance} m: give numbers above 0.")
    inwards = 0.0 if working_distance is None else float(np.degrees(np.arctan2(0.5 * baseline, working_distance)))
    half = np.array([0.5 * baseline, 0.0, 0.0])
    return camera.move(-half).perturb(-inwards), camera.move(half).perturb(inwards)


MAX_BAND_MOTION = (
    0.4  # Largest motion of points during a band of rows [pixel]; the error of a row is at most half of it.
)
MOTION_SAMPLES = 33  # Number of times at which motion during the readout is sampled.
MIN_BAND_ROWS = 4  # Minimum height of a band [rows].
ROW_ITERATIONS = 6  # Number of fixed-point iterations for the row in which a point is seen.


def compute_row_time(row: np.ndarray | float, height: int, readout_time: float) -> np.ndarray | float:
    """Compute the time [s] of a row in an image of `height` rows, relative to its middle row; rows are clipped."""
    return readout_time * (np.clip(np.asarray(row) / max(height - 1, 1), 0.0, 1.0) - 0.5)


def split_row_bands(
    get_camera: Callable[[float], Camera], readout_time: float, points: np.ndarray
) -> list[tuple[slice, Camera]]:
    """Split the image rows into bands, from top to bottom; return each band with its camera, cropped to these rows.

    `get_camera` gives the camera at a time. In each band, points (n, 3) [m] move by at most `MAX_BAND_MOTION` pixels.
    """
    middle = get_camera(0.0)
    moments = readout_time * np.linspace(-0.5, 0.5, MOTION_SAMPLES)
    pixels = np.stack([get_camera(float(moment)).project(points)[0] for moment in moments])
    fastest = float(np.nan_to_num(np.linalg.norm(np.diff(pixels, axis=0), axis=2)).max()) * (MOTION_SAMPLES - 1)
    count = int(np.clip(np.ceil(fastest / MAX_BAND_MOTION), 1, max(middle.height // MIN_BAND_ROWS, 1)))
    edges = np.linspace(0, middle.height, count + 1).round().astype(int).tolist()
    bands = []
    for top, low in pairwise(edges):
        camera = get_camera(float(compute_row_time(0.5 * (top + low - 1), middle.height, readout_time)))
        bands.append((slice(top, low), camera.crop_to(slice(top, low), slice(0, middle.width))))
    return bands


def find_row_time(get_camera: Callable[[float], Camera], readout_time: float, point: np.ndarray) -> float:
    """Compute the time [s] of the row in which a point (3,) [m] is visible; 0 if the point is not projected."""
    time = 0.0
    for _ in range(ROW_ITERATIONS):
        camera = get_camera(time)
        (pixel,), _ = camera.project(point[None])
        if not np.isfinite(pixel).all():
            return 0.0
        time = float(compute_row_time(float(pixel[1]), camera.height, readout_time))
    return time

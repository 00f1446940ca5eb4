"""Rectification of stereo pairs: windows round a target, with corresponding rows."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera

# Smallest share of the baseline along the left eye's rows, as the right eye must be to the right of the left eye.
MIN_BASELINE_SHARE = 0.9
Maps = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Rectified windows of a stereo pair; points at the target's depth have the same position in both windows.

    Fusiello, Trucco, Verri 2000, "A compact algorithm for rectification of stereo pairs", Mach. Vis. Appl. 12:16-22.

    Parameters
    ----------
    T_window_world
        Transform (4, 4) from the world to the left camera's rectified frame [m]; its x axis points to the right camera.
    focal, principal
        Focal length and principal point (2,) of the left window [pixel].
    baseline, depth
        Distance between the cameras, and depth of the target along the rectified axis [m].
    size
        Side length of a window [pixel].
    maps
        Image positions of the windows' pixels, for the left and for the right camera.
    """

    T_window_world: np.ndarray
    focal: float
    principal: np.ndarray
    baseline: float
    depth: float
    size: int
    maps: tuple[Maps, Maps]

    def rectify(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rectify images (H, W, ...) uint8 of both eyes to windows (size, size, ...), black outside the images."""
        one, other = self.maps
        return cv2.remap(left, *one, cv2.INTER_LINEAR), cv2.remap(right, *other, cv2.INTER_LINEAR)

    @property
    def depth_disparity(self) -> float:
        """Product of depth [m] and disparity [pixel], for a disparity that is 0 at infinity."""
        return self.focal * self.baseline

    def compute_disparity(self, depth: np.ndarray) -> np.ndarray:
        """Compute disparities [pixel] of depths [m]: shift to the left in the right window, 0 at the target."""
        return self.depth_disparity / depth - self.depth_disparity / self.depth

    def project_points(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (n, 3) [m] to pixels (n, 2) of the left window; return also their disparities (n,)."""
        at = points @ self.T_window_world[:3, :3].T + self.T_window_world[:3, 3]
        return self.focal * at[:, :2] / at[:, 2:] + self.principal, self.compute_disparity(at[:, 2])

    def compute_points(self, pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """Compute the world points (n, 3) [m] at pixels (n, 2) of the left window with given disparities (n,)."""
        depth = self.compute_depths(disparity)
        ray = np.column_stack([(pixels - self.principal) / self.focal, np.ones(len(pixels))])
        return (depth[:, None] * ray - self.T_window_world[:3, 3]) @ self.T_window_world[:3, :3]

    def compute_depths(self, disparity: np.ndarray) -> np.ndarray:
        """Compute depths [m] from disparities [pixel]."""
        return self.depth_disparity / (disparity + self.depth_disparity / self.depth)


@lru_cache(maxsize=4)
def build_rectification(
    left: Camera, right: Camera, target: tuple[float, float, float], half_width: float, pixels_per_metre: float
) -> RectifiedPair:
    """Rectify round a target [m]: windows with `half_width` [m] and `pixels_per_metre`, both at the target's depth.

    Raises
    ------
    ValueError
        The right eye is not to the right of the left eye, or the target is not in front of both.
    """
    between = right.centre - left.centre
    baseline = float(np.linalg.norm(between))
    if not left.T_camera_world[0, :3] @ between > MIN_BASELINE_SHARE * baseline or not baseline > 0.0:
        raise ValueError("the right eye is not to the right of the left one: check which is which.")
    x = between / baseline
    y = np.cross(left.T_camera_world[2, :3] + right.T_camera_world[2, :3], x)
    R = np.stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ left.centre
    at = R @ np.asarray(target) + T[:3, 3]
    if not at[2] > 0.0:
        raise ValueError("the target is not ahead of the eyes: check where they are.")
    size, focal = 2 * round(half_width * pixels_per_metre), pixels_per_metre * float(at[2])
    middle = 0.5 * (size - 1)
    principal = middle - focal * at[:2] / at[2]
    shift = np.array([focal * baseline / at[2], 0.0])
    maps = tuple(
        _build_maps(eye, R, focal, place, size) for eye, place in ((left, principal), (right, principal + shift))
    )
    return RectifiedPair(T, focal, principal, baseline, float(at[2]), size, (maps[0], maps[1]))


def _build_maps(eye: Camera, R: np.ndarray, focal: float, principal: np.ndarray, size: int) -> Maps:
    K = np.array([[focal, 0.0, principal[0]], [0.0, focal, principal[1]], [0.0, 0.0, 1.0]])
    turn = R @ eye.T_camera_world[:3, :3].T
    return cv2.initUndistortRectifyMap(eye.K, eye.distortion, turn, K, (size, size), cv2.CV_16SC2)

"""Lens distortion by the model of Brown and Conrady, with the coefficients and their order as in OpenCV.

Image positions in this module are normalised: (x, y) = (X / Z, Y / Z) of a point in the camera frame.
"""

from dataclasses import astuple, dataclass
from functools import cached_property, lru_cache

import numpy as np

MAX_ANGLE = np.radians(88.0)  # Largest angle from the optical axis for which `Lens.reach` is searched [rad].
RADIUS_COUNT = 4096  # Number of radii, from the axis outwards, at which the mapping is sampled.
DIRECTION_COUNT = 32  # Number of directions round the axis at which the mapping is sampled.
MAX_NEWTON_ITERATIONS = 20  # Maximum number of Newton iterations of the inverse mapping.
# Residual that ends the Newton iterations, in normalised coordinates: 1e-9 pixel at a focal length of 1000 pixels.
NEWTON_TOLERANCE = 1e-12
CHUNK_POINTS = 8192  # Chunk size [points]: its arrays fit in the CPU cache; without chunks it takes 1.5 times as long.


@dataclass(frozen=True)
class Lens:
    """Distortion of a camera lens.

    With r^2 = x^2 + y^2 and q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), (x, y) is mapped to

        (x q + 2 p1 x y + p2 (r^2 + 2 x^2), y q + p1 (r^2 + 2 y^2) + 2 p2 x y).

    Brown (1971), "Close-range camera calibration"; with k4, k5 and k6 as in OpenCV's rational model.

    Raises
    ------
    ValueError
        A coefficient is not finite, or the distortion is not one-to-one even at the image's centre.

    Examples
    --------
    >>> from ar import Lens
    >>> Lens(k1=-0.2, k2=0.05).distort(np.array([0.3, 0.0])).round(3).tolist()  # x / z, y / z
    [0.295, 0.0]
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients).all():
            raise ValueError(f"a lens takes finite coefficients, not {self.coefficients.tolist()}: calibrate again.")
        if not self.reach > 0.0:
            raise ValueError(f"a lens of {self.coefficients.tolist()} folds the whole image: calibrate again.")

    @property
    def coefficients(self) -> np.ndarray:
        """Coefficients (8,) in OpenCV's order, for `cv2.projectPoints`."""
        return np.array(astuple(self), np.float64)

    @cached_property
    def reach(self) -> float:
        """Largest distance X / Z from the axis at which the distortion is one-to-one; points beyond are not projected.

        Polynomials fold back at large distances. In a disc where the Jacobian's symmetric part is positive definite, no
        two points have the same image.
        """
        radii = np.tan(np.linspace(0.0, MAX_ANGLE, RADIUS_COUNT))
        angles = np.linspace(0.0, 2.0 * np.pi, DIRECTION_COUNT, endpoint=False)
        x, y = np.multiply.outer(radii, [np.cos(angles), np.sin(angles)]).transpose(1, 0, 2)
        with np.errstate(all="ignore"):
            a, b, c = self._compute_slopes(x, y)
            r2 = radii**2
            good = (
                (a + c > 0.0) & (a * c > b * b) & (1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)) > 0.0)[:, None]
            )
        folds = np.flatnonzero(~good.all(axis=1))
        return float(radii[-1] if not len(folds) else radii[max(folds[0] - 1, 0)])

    def distort(self, places: np.ndarray) -> np.ndarray:
        """Map undistorted positions (..., 2) to distorted positions; NaN beyond `reach`."""
        x, y = places[..., 0], places[..., 1]
        with np.errstate(invalid="ignore"):
            seen = np.hypot(x, y) <= self.reach
        x, y = np.where(seen, x, np.nan), np.where(seen, y, np.nan)
        return np.stack(self._apply_distortion(x, y), axis=-1)

    def undistort(self, places: np.ndarray) -> np.ndarray:
        """Map distorted positions (..., 2) to undistorted ones by Newton's method; NaN if there are none in `reach`."""
        places = np.asarray(places, np.float64)
        wanted = places.reshape(-1, 2).T
        _, moved = self._distorted_radii
        # Upper bound of positions with the tangential part.
        far = moved[-1] + 3.0 * (abs(self.p1) + abs(self.p2)) * self.reach**2
        near = np.flatnonzero(np.hypot(*wanted) <= far)
        out = np.full(wanted.shape, np.nan)
        for part in np.split(near, range(CHUNK_POINTS, len(near), CHUNK_POINTS)):
            out[:, part] = self._undistort_points(wanted[:, part])
        return out.T.reshape(places.shape)

    def _undistort_points(self, distorted: np.ndarray) -> np.ndarray:
        """Undistort normalised positions (2, n); return (2, n), NaN where Newton's method fails."""
        far = np.hypot(*distorted)
        # Start: without its tangential part the lens moves positions along rays.
        radii, moved = self._distorted_radii
        x, y = np.interp(far, moved, radii) / np.where(far > 0.0, far, 1.0) * distorted
        for _ in range(MAX_NEWTON_ITERATIONS):
            at = self._apply_distortion(x, y)
            off_x, off_y = at[0] - distorted[0], at[1] - distorted[1]
            if max(np.abs(off_x).max(initial=0.0), np.abs(off_y).max(initial=0.0)) <= NEWTON_TOLERANCE:
                break
            a, b, c = self._compute_slopes(x, y)
            inverse = 1.0 / (a * c - b * b)
            x, y = x - inverse * (c * off_x - b * off_y), y - inverse * (a * off_y - b * off_x)
            # Derivatives beyond `reach` are meaningless: longer steps end at `reach`.
            back = np.minimum(1.0, self.reach / np.maximum(np.hypot(x, y), self.reach))
            x, y = back * x, back * y
        at = self._apply_distortion(x, y)
        found = np.hypot(at[0] - distorted[0], at[1] - distorted[1]) < 1e3 * NEWTON_TOLERANCE
        return np.where(found, (x, y), np.nan)

    @cached_property
    def _distorted_radii(self) -> tuple[np.ndarray, np.ndarray]:
        """Distances from the axis, undistorted and distorted (tangential part excluded), both ascending."""
        radii = np.linspace(0.0, self.reach, RADIUS_COUNT)
        moved = radii * self._compute_radial(radii**2)[0]
        return radii, np.maximum.accumulate(moved)

    def _compute_radial(self, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the radial factor q at `r2` = r^2, and its derivative by r^2."""
        over = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        under = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        steep = self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3)
        lower = self.k4 + r2 * (2.0 * self.k5 + 3.0 * r2 * self.k6)
        q = over / under
        return q, (steep - q * lower) / under

    def _apply_distortion(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distort (x, y), also beyond `reach`."""
        r2, xy = x * x + y * y, 2.0 * x * y
        q, _ = self._compute_radial(r2)
        return (
            x * q + self.p1 * xy + self.p2 * (r2 + 2.0 * x * x),
            y * q + self.p1 * (r2 + 2.0 * y * y) + self.p2 * xy,
        )

    def _compute_slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the entries (xx, xy, yy) of the distortion's Jacobian, which is symmetric."""
        q, steep = self._compute_radial(x * x + y * y)
        across = 2.0 * steep * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        return (
            q + 2.0 * steep * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            across,
            q + 2.0 * steep * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        )

    bent, straight = distort, undistort  # Former names, for one release.


@lru_cache(maxsize=4)
def undistort_pixels(lens: Lens, K: tuple[float, ...], width: int, height: int) -> np.ndarray:
    """Compute each pixel's undistorted position (H, W, 2) [pixel]; NaN without one. K (9,) is in row-major order."""
    matrix = np.reshape(K, (3, 3))
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    places = lens.undistort(to_normalised(matrix, np.stack([columns, rows], axis=-1)))
    return to_pixels(matrix, places)


def to_pixels(K: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map normalised positions (..., 2) to pixels (..., 2) by K (3, 3)."""
    return points @ K[:2, :2].T + K[:2, 2]


def to_normalised(K: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Map pixels (..., 2) to normalised positions (..., 2) by K (3, 3)."""
    return (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T

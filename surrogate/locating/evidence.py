"""What is seen of a brain, as numbers that a motion predicts: along which axis, at which material point, how surely."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, get_lapack_funcs

from sim.geometry.locate import Located

from ..array_functions import squared_distances

# How the share of an error that is not rigid is made: white, and smooth over the surface.
WHITE, SMOOTH = 0.3e-3, 0.5e-3
SIGMA = float(np.hypot(WHITE, SMOOTH))
"""What a point that is seen is off by, of what is not rigid [m]: white and smooth errors together."""
# Length of the smooth one [m].
LENGTH = 15e-3
# What no sum of shapes is nearer than to a true motion: white and smooth errors as shares of what is seen, and the
# length of the smooth one [m].
LACK_WHITE, LACK_SMOOTH, LACK_LENGTH = 0.08, 0.1, 5e-3
SHIFT = 0.8e-3
"""What all points together are off by along each axis, if nothing else is known [m]: a standard deviation."""
# How far they are turned about each axis [rad], for each metre of that.
TURN = float(np.radians(0.3)) / SHIFT

# The rigid error of a registration that slipped [m], along each axis; and one that any has, whatever is stated.
SLIPPED, LEAST_SHIFT = 10e-3, 1e-5

# Triangular matrices that are inverted at once have fewer rows than twice this.
SMALL = 48
(trtri,) = get_lapack_funcs(("trtri",), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Evidence:
    """m numbers, each what a material point's motion is seen to be along an axis.

    Parameters
    ----------
    place
        The material points of the rows, in the mesh.
    at
        (m, 3) [m] where they are at rest.
    axis
        (m, 3) unit vectors.
    value
        (m,) [m].
    sigma
        (m,) [m]: standard deviation of what is not rigid in the error.
    point
        (m,) number of the observed point that each row belongs to.
    shift
        [m]: standard deviation of the rigid error's translation along each axis.
    """

    place: Located
    at: np.ndarray
    axis: np.ndarray
    value: np.ndarray
    sigma: np.ndarray
    point: np.ndarray
    shift: float = SHIFT

    def __len__(self) -> int:
        return len(self.value)

    def rows(self, chosen: np.ndarray) -> Evidence:
        """Some rows (m,) bool or numbers."""
        place = Located(self.place.vertices[chosen], self.place.weights[chosen])
        arrays = {name: getattr(self, name)[chosen] for name in ("at", "axis", "value", "sigma", "point")}
        return replace(self, place=place, **arrays)

    @property
    def middle(self) -> np.ndarray:
        """(3,) [m] about which rotations are meant."""
        return self.at.mean(axis=0)

    @property
    def rigid(self) -> np.ndarray:
        """What a rigid error does (m, 6), by translation [m] and rotation [rad] about the middle."""
        return np.concatenate([self.axis, np.cross(self.at - self.middle, self.axis)], axis=1)

    @property
    def rigid_alone(self) -> np.ndarray:
        """The rigid error (6,) [m, rad] that explains most with a body at rest, by least squares, however large."""
        return np.linalg.lstsq(self.rigid, self.value, rcond=None)[0]

    @property
    def rigid_scale(self) -> np.ndarray:
        """Standard deviations (6,) of the prior of a rigid error: translation [m], rotation [rad]."""
        return max(self.shift, LEAST_SHIFT) * np.repeat([1.0, TURN], 3)

    @property
    def beyond(self) -> float:
        """How many times as large as is stated `rigid_alone` is: its shift or its turn, whichever is more."""
        return float((np.linalg.norm(self.rigid_alone.reshape(2, 3), axis=1) / self.rigid_scale[[0, 3]]).max())

    @property
    def slip(self) -> float:
        """Standard deviation of the rigid error of a registration that slipped, as a share of the stated one."""
        return max(SLIPPED / max(self.shift, LEAST_SHIFT), 1.0)

    def noise(self, scale: float = 0.0) -> np.ndarray:
        """Covariance (m, m) [m^2] of errors that are not rigid, and of what shapes lack where `scale` [m] is seen."""
        share, square = (WHITE / SIGMA) ** 2, squared_distances(self.at, self.at)
        out = alike(square, LENGTH) * self.sigma * ((1.0 - share) * self.sigma)[:, None]
        out += alike(square, LACK_LENGTH) * (LACK_SMOOTH * scale) ** 2
        out *= self.axis @ self.axis.T
        out[np.diag_indices(len(self))] += share * self.sigma**2 + (LACK_WHITE * scale) ** 2
        return out

    @property
    def named(self) -> bool:
        """Whether points have names: each gives three rows then, and one of a cloud. So do tips."""
        return len(self) >= 2 * len(np.unique(self.point))

    @property
    def copies(self) -> int:
        """3 where rows are of motions along three axes, point after point; else 1."""
        threefold = len(self) % 3 == 0 and np.array_equal(self.axis, np.tile(np.eye(3), (len(self) // 3, 1)))
        return 3 if threefold else 1

    @property
    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (v,) that rows are seen at, and what of their motions makes rows.

        That is (m / 3, v) where rows are of three axes, one after the other, else (m, 3 v): of all axes of a vertex.
        """
        copies = self.copies
        place = Located(self.place.vertices[::copies], self.place.weights[::copies])
        row, corner = np.nonzero(place.weights)
        vertices, number = np.unique(place.vertices[row, corner], return_inverse=True)
        weights = np.zeros((len(place.weights), len(vertices)))
        np.add.at(weights, (row, number), place.weights[row, corner])
        if copies == 1:
            weights = (weights[:, :, None] * self.axis[:, None]).reshape(len(weights), -1)
        return vertices, weights

    def whitening(self, scale: float) -> Whitening:
        """What makes errors independent and of variance 1, where `scale` [m] is seen."""
        copies = self.copies
        lower = cholesky(self.rows(np.arange(0, len(self), copies)).noise(scale), lower=True)
        return Whitening(triangular_inverse(lower), copies)


@dataclass(frozen=True, eq=False)
class Whitening:
    """The inverse R of the Cholesky factor of a covariance of errors, which is R^-1 R^-T.

    Parameters
    ----------
    root
        (m / copies, m / copies).
    copies
        3 where the errors along three axes are alike and independent, row after row; else 1.
    """

    root: np.ndarray
    copies: int

    def white(self, rows: np.ndarray) -> np.ndarray:
        """R rows, (m, k) or (m,)."""
        return (self.root @ rows.reshape(len(self.root), -1)).reshape(rows.shape)

    def back(self, rows: np.ndarray) -> np.ndarray:
        """R^T rows, (m, k) or (m,)."""
        return (self.root.T @ rows.reshape(len(self.root), -1)).reshape(rows.shape)

    @property
    def logarithm(self) -> float:
        """Of the determinant of R."""
        return self.copies * float(np.log(np.diag(self.root)).sum())

    def precision(self, table: np.ndarray) -> np.ndarray:
        """Blocks (n, c, c) of the inverse covariance, for rows (n, c): of all axes of points, where `copies` is 3."""
        columns = self.root.T[table[:, :: self.copies] // self.copies]
        alike = columns @ columns.transpose(0, 2, 1)
        return np.kron(alike, np.eye(self.copies))


def triangular_inverse(lower: np.ndarray) -> np.ndarray:
    """Inverse of a lower triangular matrix (n, n), by halves: products are what a library does fastest."""
    half = len(lower) // 2
    if half < SMALL:
        return trtri(lower.T, lower=0)[0].T
    found = np.zeros_like(lower)
    found[:half, :half] = triangular_inverse(lower[:half, :half])
    found[half:, half:] = triangular_inverse(lower[half:, half:])
    found[half:, :half] = found[half:, half:] @ (lower[half:, :half] @ -found[:half, :half])
    return found


def alike(square: np.ndarray, length: float) -> np.ndarray:
    """Correlation (n, n) of smooth errors at squared distances (n, n) [m^2], which fades over a length [m]."""
    return np.exp(square * (-0.5 / length**2))


def smooth_root(points: np.ndarray, length: float = LENGTH) -> np.ndarray:
    """What makes (n, n) smooth errors at points (n, 3) [m] of independent ones, all of variance 1."""
    value, vector = np.linalg.eigh(alike(squared_distances(points, points), length))
    return vector * np.sqrt(np.maximum(value, 0.0))


def of_motions(place: Located, at: np.ndarray, motion: np.ndarray, sigma: np.ndarray, shift: float = SHIFT) -> Evidence:
    """Points (n, 3) [m] at rest and how each was seen to move (n, 3) [m]; three rows a point."""
    count = len(at)
    point = np.repeat(np.arange(count), 3)
    return Evidence(
        Located(place.vertices[point], place.weights[point]),
        at[point],
        np.tile(np.eye(3), (count, 1)),
        motion.ravel(),
        sigma[point],
        point,
        shift,
    )

"""Observations as linear data: displacements of material points along given axes, with their error covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, get_lapack_funcs

from sim.geometry.locate import LocatedPoints

from ..array_functions import compute_squared_distances

SHIFT_ERROR = 0.8e-3
"""Default standard deviation of the rigid error's translation (registration shift) along each axis [m]."""
# Rotation error about each axis per metre of registration shift [rad/m].
TURN_PER_SHIFT = float(np.radians(0.3)) / SHIFT_ERROR
SLIPPED_ERROR = 10e-3  # Rigid error of a failed registration along each axis [m].
MIN_SHIFT = 1e-5  # Smallest rigid error of any registration along each axis [m].
BLOCK_SIZE = 48  # Block size: triangular matrices with fewer than twice this many rows are inverted directly.
(trtri,) = get_lapack_funcs(("trtri",), dtype=np.float64)


@dataclass(frozen=True)
class NoiseSettings:
    """Settings of the error covariances of observed points and of the prior's shapes."""

    independent_error: float = 0.3e-3  # Independent part of a point's non-rigid error [m].
    correlated_error: float = 0.5e-3  # Spatially correlated part of a point's non-rigid error [m].
    correlation_length: float = 15e-3  # Correlation length of a point's correlated non-rigid error [m].
    independent_model_error: float = 0.08  # Independent model error of the shapes as a share of the observed motion.
    correlated_model_error: float = 0.1  # Correlated model error of the shapes as a share of the observed motion.
    model_error_length: float = 5e-3  # Correlation length of the correlated model error [m].


NOISE = NoiseSettings()
SIGMA = float(np.hypot(NOISE.independent_error, NOISE.correlated_error))
"""Standard deviation of a point's non-rigid error along each axis [m]: independent and correlated part together."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Observed displacements (m,) of material points, each along one axis.

    Parameters
    ----------
    location
        Position of each row's material point in the mesh.
    positions
        Undeformed positions (m, 3) [m] of the material points.
    axis
        Unit vectors (m, 3), along which displacements are observed.
    motion
        Observed displacements (m,) [m].
    sigma
        Standard deviations (m,) [m] of the non-rigid errors.
    point
        Number (m,) of the observed point that each row belongs to.
    shift_sigma
        Standard deviation [m] of the rigid error's translation along each axis.
    """

    location: LocatedPoints
    positions: np.ndarray
    axis: np.ndarray
    motion: np.ndarray
    sigma: np.ndarray
    point: np.ndarray
    shift_sigma: float = SHIFT_ERROR

    def __len__(self) -> int:
        return len(self.motion)

    def select(self, rows: np.ndarray) -> Evidence:
        """Select rows by a mask (m,) or by indices."""
        place = LocatedPoints(self.location.vertices[rows], self.location.weights[rows])
        arrays = {name: getattr(self, name)[rows] for name in ("positions", "axis", "motion", "sigma", "point")}
        return replace(self, location=place, **arrays)

    @property
    def centroid(self) -> np.ndarray:
        """Centroid (3,) [m] of the undeformed positions, about which rigid errors rotate."""
        return self.positions.mean(axis=0)

    @property
    def rigid_jacobian(self) -> np.ndarray:
        """Matrix (m, 6) from a rigid error to rows: translation [m], then rotation [rad] about the centroid."""
        return np.concatenate([self.axis, np.cross(self.positions - self.centroid, self.axis)], axis=1)

    @property
    def rigid_fit(self) -> np.ndarray:
        """Rigid error (6,) [m, rad] that fits the observation best by least squares, with the brain undeformed."""
        return np.linalg.lstsq(self.rigid_jacobian, self.motion, rcond=None)[0]

    @property
    def rigid_scale(self) -> np.ndarray:
        """Prior standard deviations (6,) of the rigid error: translation [m], then rotation [rad]."""
        return max(self.shift_sigma, MIN_SHIFT) * np.repeat([1.0, TURN_PER_SHIFT], 3)

    @property
    def rigid_ratio(self) -> float:
        """Size of `rigid_fit` relative to the reported rigid error: the larger ratio of translation and rotation."""
        return float((np.linalg.norm(self.rigid_fit.reshape(2, 3), axis=1) / self.rigid_scale[[0, 3]]).max())

    @property
    def slip_ratio(self) -> float:
        """Standard deviation of the rigid error of a slipped registration, relative to the reported one; at least 1."""
        return max(SLIPPED_ERROR / max(self.shift_sigma, MIN_SHIFT), 1.0)

    def compute_covariance(self, scale: float = 0.0) -> np.ndarray:
        """Compute the covariance (m, m) [m^2] of non-rigid errors and of model errors for motions of `scale` [m]."""
        share, square = (
            (NOISE.independent_error / SIGMA) ** 2,
            compute_squared_distances(self.positions, self.positions),
        )
        out = compute_correlation(square, NOISE.correlation_length) * self.sigma * ((1.0 - share) * self.sigma)[:, None]
        out += compute_correlation(square, NOISE.model_error_length) * (NOISE.correlated_model_error * scale) ** 2
        out *= self.axis @ self.axis.T
        out[np.diag_indices(len(self))] += share * self.sigma**2 + (NOISE.independent_model_error * scale) ** 2
        return out

    @property
    def is_paired(self) -> bool:
        """True if points have correspondences, with three rows per point; points of clouds, and tips, have one row."""
        return len(self) >= 2 * len(np.unique(self.point))

    @property
    def axis_count(self) -> int:
        """Number of axes per point: 3 if every point has a row for each of the axes, in order; else 1."""
        threefold = len(self) % 3 == 0 and np.array_equal(self.axis, np.tile(np.eye(3), (len(self) // 3, 1)))
        return 3 if threefold else 1

    @property
    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (v,) that the rows depend on, and the matrix from the vertices' displacements to the rows.

        The matrix is (m / 3, v), for each axis, if `axis_count` is 3; else (m, 3 v), for all axes of the vertices.
        """
        copies = self.axis_count
        place = LocatedPoints(self.location.vertices[::copies], self.location.weights[::copies])
        row, corner = np.nonzero(place.weights)
        vertices, number = np.unique(place.vertices[row, corner], return_inverse=True)
        weights = np.zeros((len(place.weights), len(vertices)))
        np.add.at(weights, (row, number), place.weights[row, corner])
        if copies == 1:
            weights = (weights[:, :, None] * self.axis[:, None]).reshape(len(weights), -1)
        return vertices, weights

    def build_whitening(self, scale: float) -> Whitening:
        """Build the transform to independent errors of variance 1, for motions of root mean square `scale` [m]."""
        copies = self.axis_count
        lower = cholesky(self.select(np.arange(0, len(self), copies)).compute_covariance(scale), lower=True)
        return Whitening(invert_triangular(lower), copies)


@dataclass(frozen=True, eq=False)
class Whitening:
    """Whitening transform: inverse R of the Cholesky factor of an error covariance R^-1 R^-T.

    Parameters
    ----------
    root
        Matrix R (m / axis_count, m / axis_count).
    axis_count
        3 if the errors along three axes are independent and have the same covariance; else 1.
    """

    root: np.ndarray
    axis_count: int

    def whiten(self, rows: np.ndarray) -> np.ndarray:
        """Compute the product of R with rows (m, k) or (m,)."""
        return (self.root @ rows.reshape(len(self.root), -1)).reshape(rows.shape)

    def transform_back(self, rows: np.ndarray) -> np.ndarray:
        """Compute the product of R^T with rows (m, k) or (m,)."""
        return (self.root.T @ rows.reshape(len(self.root), -1)).reshape(rows.shape)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of R."""
        return self.axis_count * float(np.log(np.diag(self.root)).sum())

    def compute_precision(self, rows: np.ndarray) -> np.ndarray:
        """Compute blocks (n, c, c) of the inverse covariance for rows (n, c); each has all axes of its points."""
        columns = self.root.T[rows[:, :: self.axis_count] // self.axis_count]
        alike = columns @ columns.transpose(0, 2, 1)
        return np.kron(alike, np.eye(self.axis_count))


def invert_triangular(lower: np.ndarray) -> np.ndarray:
    """Invert a lower triangular matrix (n, n) by recursive halving, which uses fast matrix products."""
    half = len(lower) // 2
    if half < BLOCK_SIZE:
        return trtri(lower.T, lower=0)[0].T
    found = np.zeros_like(lower)
    found[:half, :half] = invert_triangular(lower[:half, :half])
    found[half:, half:] = invert_triangular(lower[half:, half:])
    found[half:, :half] = found[half:, half:] @ (lower[half:, :half] @ -found[:half, :half])
    return found


def compute_correlation(squared_distance: np.ndarray, length: float) -> np.ndarray:
    """Compute correlations (n, n) of smooth noise: Gaussian of squared distances (n, n) [m^2], with a length [m]."""
    return np.exp(squared_distance * (-0.5 / length**2))


def compute_correlation_root(points: np.ndarray, length: float = NOISE.correlation_length) -> np.ndarray:
    """Compute the factor (n, n) from independent noise at points (n, 3) [m] to correlated noise of variance 1."""
    value, vector = np.linalg.eigh(compute_correlation(compute_squared_distances(points, points), length))
    return vector * np.sqrt(np.maximum(value, 0.0))


def build_motion_evidence(
    location: LocatedPoints,
    positions: np.ndarray,
    motion: np.ndarray,
    sigma: np.ndarray,
    shift_sigma: float = SHIFT_ERROR,
) -> Evidence:
    """Build evidence from undeformed points (n, 3) [m] and their motions (n, 3) [m], with three rows per point."""
    count = len(positions)
    point = np.repeat(np.arange(count), 3)
    location, axis = LocatedPoints(location.vertices[point], location.weights[point]), np.tile(np.eye(3), (count, 1))
    return Evidence(location, positions[point], axis, motion.ravel(), sigma[point], point, shift_sigma)

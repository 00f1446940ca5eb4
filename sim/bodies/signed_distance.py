"""Level set functions of solids: negative inside and zero on the surface; level sets of voxel masks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage, special

Field = Callable[[np.ndarray], np.ndarray]
"""Level set function of a solid: values (n,) [m] at points (n, 3) [m]; near the surface, the signed distance."""


@dataclass(frozen=True)
class Blur:
    """Smoothing of a voxel mask.

    Parameters
    ----------
    sigma
        Standard deviation [voxels]. The default smooths the steps of a mask and preserves features above two voxels.
    max_distance
        Distance from the surface [standard deviations] beyond which only the sign of the level set is accurate.
    margin
        Margin of the level set around its mask [voxels]; larger than the range of the blur.
    """

    sigma: float = 0.7
    max_distance: float = 3.5
    margin: int = 5


@dataclass(frozen=True, eq=False)
class LevelSet:
    """Level set sampled on voxels, trilinear between them and constant outside.

    `values` (I, J, K) float32 [m]; `inverse` (4, 4): affine from homogeneous points [m] to voxel indices.
    """

    values: np.ndarray
    inverse_affine: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the values (n,) [m] at points (n, 3) [m]."""
        index = self.inverse_affine[:3, :3] @ points.T + self.inverse_affine[:3, 3:]
        return ndimage.map_coordinates(self.values, index, order=1, mode="nearest", output=np.float64)


def compute_level_set(mask: np.ndarray, affine: np.ndarray, blur: Blur = Blur()) -> LevelSet:
    """Return the level set of a voxel `mask` (I, J, K) with an `affine` (4, 4) from voxel indices to metres.

    The mask is blurred. The distance d follows from the blurred value P by inversion of P = Phi(-d / sigma), which is
    exact for a half-space. For anisotropic voxels, sigma is a geometric mean, so distances have a scale error.
    """
    mask, affine = crop_to_mask(mask, affine, blur.margin)
    sigma = blur.sigma * abs(np.linalg.det(affine[:3, :3])) ** (1.0 / 3.0)
    share = ndimage.gaussian_filter(mask.astype(np.float32), blur.sigma, mode="nearest")
    limit = special.ndtr(-blur.max_distance)
    distance = -sigma * special.ndtri(np.clip(share, limit, 1.0 - limit))
    return LevelSet(distance.astype(np.float32), np.linalg.inv(affine))


def crop_to_mask(mask: np.ndarray, affine: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask cropped to its marked voxels with a `margin` of voxels, zero-padded, and its affine (4, 4)."""
    (box,) = cast(list[tuple[slice, ...]], ndimage.find_objects(mask.astype(np.uint8)))
    low, shifted = np.array([part.start for part in box]) - margin, affine.copy()
    shifted[:3, 3] += affine[:3, :3] @ low
    return np.pad(mask[box], margin), shifted


def compute_gradient(field: Field, points: np.ndarray, probe: float = 2e-4) -> np.ndarray:
    """Compute the gradient (n, 3) of a field at points (n, 3) [m] by central differences with step `probe` [m].

    The default step is smaller than a voxel and much larger than round-off.
    """
    steps = probe * np.eye(3)
    return np.stack([field(points + step) - field(points - step) for step in steps], axis=1) / (2.0 * probe)


def project_onto_level(field: Field, points: np.ndarray, level: np.ndarray, min_slope: float = 0.1) -> np.ndarray:
    """Return points (n, 3) [m], moved along the gradient of a field to the values `level` (n,) by two Newton steps.

    A distance field has slope 1. Slopes below `min_slope` occur between two surfaces or far from all surfaces, where
    the direction of the gradient is noise; at such points the step is shortened.
    """
    for _ in range(2):
        slope = compute_gradient(field, points)
        square = np.einsum("ni,ni->n", slope, slope)
        excess = (field(points) - level) / np.maximum(square, min_slope**2)
        points = points - excess[:, None] * slope
    return points

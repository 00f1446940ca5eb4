"""Solids as fields: negative inside, zero on the surface, and the field of a mask of voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage, special

Field = Callable[[np.ndarray], np.ndarray]
"""A solid: values (n,) at points (n, 3) [m], negative inside, continuous; near its surface the distance to it [m]."""


@dataclass(frozen=True)
class Blur:
    """How the field of a mask of voxels is made smooth.

    Parameters
    ----------
    voxels
        Standard deviation: takes the staircase off a mask and leaves what is wider than two voxels where it is.
    reach
        Standard deviations from the surface beyond which a blurred mask tells no more than inside or outside.
    margin
        Voxels of surroundings that a field keeps round its mask: more than the blur reaches.
    """

    voxels: float = 0.7
    reach: float = 3.5
    margin: int = 5


@dataclass(frozen=True, eq=False)
class LevelSet:
    """A field sampled on voxels, trilinear between them and constant beyond.

    values (I, J, K) float32 [m]; inverse (4, 4): homogeneous points [m] to voxel indices.
    """

    values: np.ndarray
    inverse: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) [m] at points (n, 3) [m]."""
        index = self.inverse[:3, :3] @ points.T + self.inverse[:3, 3:]
        return ndimage.map_coordinates(self.values, index, order=1, mode="nearest", output=np.float64)


def mask_field(mask: np.ndarray, affine: np.ndarray, blur: Blur = Blur()) -> LevelSet:
    """Return the field of the voxels `mask` (I, J, K) bool whose indices `affine` (4, 4) takes to metres.

    The mask is blurred and the blur of a plane, P = Phi(-d / sigma), is solved for the distance d.
    Where voxels are oblong the mean of the three blurs stands for sigma, so that distances are right to a factor.
    """
    mask, affine = crop_to(mask, affine, blur.margin)
    sigma = blur.voxels * abs(np.linalg.det(affine[:3, :3])) ** (1.0 / 3.0)
    share = ndimage.gaussian_filter(mask.astype(np.float32), blur.voxels, mode="nearest")
    limit = special.ndtr(-blur.reach)
    distance = -sigma * special.ndtri(np.clip(share, limit, 1.0 - limit))
    return LevelSet(distance.astype(np.float32), np.linalg.inv(affine))


def crop_to(mask: np.ndarray, affine: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of a mask within `margin` voxels of what is marked, padded with zeros, and its affine (4, 4)."""
    (box,) = cast(list[tuple[slice, ...]], ndimage.find_objects(mask.astype(np.uint8)))
    low = np.array([part.start for part in box]) - margin
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, :3] @ low
    return np.pad(mask[box], margin), shifted


def compute_gradient(field: Field, points: np.ndarray, probe: float = 2e-4) -> np.ndarray:
    """Gradient (n, 3) of a field at points (n, 3) [m], by differences `probe` [m] to both sides.

    The default is below a voxel and above round-off.
    """
    steps = probe * np.eye(3)
    return np.stack([field(points + step) - field(points - step) for step in steps], axis=1) / (2.0 * probe)


def project_onto_level(field: Field, points: np.ndarray, level: np.ndarray, flat: float = 0.1) -> np.ndarray:
    """Points (n, 3) [m] moved along the gradient to where the field has the value `level` (n,): two Newton steps.

    A distance has slope 1. Slopes below `flat` lie between two surfaces or far from any, and their direction is noise:
    the flatter the field, the shorter the step.
    """
    for _ in range(2):
        slope = compute_gradient(field, points)
        square = np.einsum("ni,ni->n", slope, slope)
        excess = (field(points) - level) / np.maximum(square, flat**2)
        points = points - excess[:, None] * slope
    return points

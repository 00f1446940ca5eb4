"""Solids as fields: negative inside, zero on the surface, and the field of a mask of voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage, special

Field = Callable[[np.ndarray], np.ndarray]
"""A solid: values (n,) at points (n, 3) [m], negative inside, continuous; near its surface the distance to it [m]."""

PROBE = 2e-4  # [m] for differences of a field: below a voxel, above round-off
BLUR = 0.7  # voxels; takes the staircase off a mask and leaves what is wider than two voxels where it is
REACH = 3.5  # blurs; farther from the surface than this the blurred mask says no more than inside or outside
MARGIN = 5  # voxels of surroundings that a field keeps round its mask


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


def mask_field(mask: np.ndarray, affine: np.ndarray) -> LevelSet:
    """The field of the voxels `mask` (I, J, K) bool whose indices `affine` (4, 4) takes to metres.

    The mask is blurred by 0.7 voxels and the blur of a plane, P = Phi(-d / sigma), is solved for the distance d.
    Where voxels are oblong the mean of the three blurs stands for sigma, so that distances are right to a factor.
    """
    mask, affine = cropped(mask, affine)
    sigma = BLUR * abs(np.linalg.det(affine[:3, :3])) ** (1.0 / 3.0)
    share = ndimage.gaussian_filter(mask.astype(np.float32), BLUR, mode="nearest")
    limit = special.ndtr(-REACH)
    distance = -sigma * special.ndtri(np.clip(share, limit, 1.0 - limit))
    return LevelSet(distance.astype(np.float32), np.linalg.inv(affine))


def cropped(mask: np.ndarray, affine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of a mask within 5 voxels of what is marked, padded where the volume ends, and its affine (4, 4)."""
    (box,) = cast(list[tuple[slice, ...]], ndimage.find_objects(mask.astype(np.uint8)))
    low = np.array([part.start for part in box]) - MARGIN
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, :3] @ low
    return np.pad(mask[box], MARGIN), shifted


def gradient(field: Field, points: np.ndarray) -> np.ndarray:
    """Gradient (n, 3) of a field at points (n, 3) [m], by central differences over 0.4 mm."""
    steps = PROBE * np.eye(3)
    return np.stack([field(points + step) - field(points - step) for step in steps], axis=1) / (2.0 * PROBE)


def onto_level(field: Field, points: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Points (n, 3) [m] moved along the gradient to where the field has the value `level` (n,): two Newton steps."""
    for _ in range(2):
        slope = gradient(field, points)
        square = np.einsum("ni,ni->n", slope, slope)
        excess = (field(points) - level) / np.where(square > 0.0, square, np.inf)
        points = points - excess[:, None] * slope
    return points

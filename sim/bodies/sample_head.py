"""Synthetic patient with the brain surface of an anatomy, as label map and T1, for users without patient data."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..anatomy import BRAIN_LABEL, TUMOUR_LABEL
from ..geometry.tetmesh import TetMesh
from .enclosed_voxels import rasterise_interior
from .intensity import Intensity
from .template import HealthyHead, Lobes, Tumour, build_synthetic_subject

SAMPLE_TUMOUR = Tumour(0.012, shape="lobed", seed=3, middle=(-0.028, 0.018, 0.034), lobes=Lobes(height=1.0))
"""Tumour of the sample patient: left frontal."""


@dataclass(frozen=True)
class SampleHead:
    """Shape, tumour, voxels and grey values of the sample patient; lengths in metres, angles in radians."""

    stretch: tuple[float, float, float] = (0.97, 1.03, 0.98)  # Factors of the brain's coordinates (x, y, z).
    tumour: Tumour = SAMPLE_TUMOUR  # Tumour in the stretched brain.
    # Voxel edges; the axes point to the left, back and top before they are rotated.
    voxel: tuple[float, float, float] = (1.6e-3, 1.6e-3, 1.8e-3)
    angles: tuple[float, float] = (0.20, 0.07)  # Rotation of the voxel axes about the x axis, then about the z axis.
    sulcus_depth: float = 18e-3  # Depth of the sulci.
    sulcus_distance: float = 22e-3  # Length scale of the distances between sulci.
    layers: tuple[float, ...] = (0.5e-3, 1.5e-3, 3e-3, 5e-3)  # Distances from the fluid in which `greys` are reached.
    greys: tuple[float, ...] = (40.0, 120.0, 120.0, 190.0)  # Grey values, 8 bits: fluid, cortex (twice), white matter.
    tumour_grey: float = 90.0  # Grey value of the tumour.
    seed: int = 1  # Random seed of the sulci.


def build_sample_head(brain: TetMesh, head: SampleHead = SampleHead()) -> tuple[Intensity, Intensity]:
    """Return the label map (`BRAIN_LABEL`, `TUMOUR_LABEL`) and the T1 of a patient, as 8-bit volumes on one grid.

    `brain` is the mesh whose surface is used. Only the T1 shows sulci.

    Raises
    ------
    InputError
        The surface is not closed, or the tumour would extend beyond the brain.
    """
    (a, b), (c, d) = ((np.cos(angle), np.sin(angle)) for angle in head.angles)
    edges = np.array([[c, -d * a, d * b], [d, c * a, -c * b], [0.0, b, a]]) * head.voxel * [-1.0, -1.0, 1.0]
    mask, affine = rasterise_interior((brain.nodes * head.stretch) @ np.linalg.inv(edges).T, brain.surface, 1.0)
    affine[:3] = edges @ affine[:3]
    points = np.argwhere(np.ones_like(mask)) @ edges.T + affine[:3, 3]
    tumour = build_synthetic_subject(head.tumour, HealthyHead(mask, affine)).tumour(points).reshape(mask.shape)
    labels = np.where(mask, np.where(tumour < 0.0, TUMOUR_LABEL, BRAIN_LABEL), 0).astype(np.uint8)
    return Intensity(labels, affine), Intensity(_draw_t1(mask, tumour, head), affine)


def _draw_t1(mask: np.ndarray, tumour_distance: np.ndarray, head: SampleHead) -> np.ndarray:
    """Return grey values (I, J, K) uint8, from a brain mask and the signed distance to the tumour, each (I, J, K) [m].

    The sulci are the zero crossings of band-pass filtered noise.
    """
    noise = np.random.default_rng(head.seed).standard_normal(mask.shape)
    scale = head.sulcus_distance / np.array(head.voxel)
    wave = ndimage.gaussian_filter(noise, 0.2 * scale) - ndimage.gaussian_filter(noise, 0.4 * scale)
    depth = np.asarray(ndimage.distance_transform_edt(mask, sampling=head.voxel))
    sulcus = 0.25 * head.sulcus_distance * np.abs(wave) / wave.std() + np.maximum(depth - head.sulcus_depth, 0.0)
    grey = np.interp(np.minimum(depth, sulcus), head.layers, head.greys)
    grey = np.where(tumour_distance < 0.0, head.tumour_grey, grey) * mask
    return np.rint(ndimage.gaussian_filter(grey, 0.5)).astype(np.uint8)

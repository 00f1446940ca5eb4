"""T1 intensities of a mesh: a small NIfTI volume in mesh coordinates, interpolated at undeformed positions."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from ..runtime.atomic_files import write_atomically
from .volume import read_volume
from .voxels import DEFAULT_VOXELS, VoxelSpec

# Relative difference below which grey values count as equal.
GREY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class GreyWindow:
    """Mapping of a scan's grey values to 0 .. 1, independent of the scanner's scale and offset.

    Parameters
    ----------
    low_percent, high_percent
        Percentiles of the grey values in the brain, weighted by volume; robust against few voxels such as vessels.
    low_grey, high_grey
        Grey values in 0 .. 1 to which these percentiles are mapped; other values follow linearly, clipped to 0 .. 1.
    max_excess
        Excess over the upper percentile, in units of upper - lower percentile, above which a voxel is not tissue, but a
        vessel with contrast agent, fat, or a wrong value.
    flat_grey
        Grey value of all voxels if the brain has one uniform value.
    """

    low_percent: float = 5.0
    high_percent: float = 90.0
    low_grey: float = 0.3
    high_grey: float = 0.97
    max_excess: float = 1.0
    flat_grey: float = 0.8


STORED_WINDOW = GreyWindow(low_grey=0.25, high_grey=0.75)
"""Window of the file stored with a mesh; it preserves values darker or lighter than nearly all of the brain."""


@dataclass(frozen=True, eq=False)
class Intensity:
    """Grey value volume: `values` (I, J, K), and `affine` (4, 4) from voxel indices to mesh coordinates (RAS) [m]."""

    values: np.ndarray
    affine: np.ndarray

    def interpolate(self, points: np.ndarray) -> np.ndarray:
        """Return values (n,) in [0, 1] at points (n, 3) [m]: trilinear, 8-bit grey / 255, zero outside the volume."""
        inverse = np.linalg.inv(self.affine)
        index = inverse[:3, :3] @ points.T + inverse[:3, 3:]
        return ndimage.map_coordinates(self.values, index, order=1, mode="constant", output=np.float64) / 255.0

    def crop(self, points: np.ndarray, mesh: TetMesh, margin: float = 0.015) -> Intensity:
        """Return the part of the volume around points (n, 3) [m] with a `margin` [m], as 8-bit grey by `STORED_WINDOW`.

        Raises
        ------
        InputError
            The volume does not cover the bounding box of the points, or has no finite values in the brain.
        """
        inverse = np.linalg.inv(self.affine)
        index = points @ inverse[:3, :3].T + inverse[:3, 3]
        reach = margin / np.linalg.norm(self.affine[:3, :3], axis=0)
        low = np.maximum(np.floor(index.min(axis=0) - reach), 0).astype(int)
        high = np.minimum(np.ceil(index.max(axis=0) + reach) + 1, self.values.shape).astype(int)
        if (high <= low).any():
            raise InputError("the T1 volume does not cover the craniotomy: give one in the labels' own space.")
        affine = self.affine.copy()
        affine[:3, 3] += self.affine[:3, :3] @ low
        part = Intensity(self.values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], affine)
        return Intensity(np.rint(255.0 * part.apply_window(mesh, STORED_WINDOW)).astype(np.uint8), affine)

    def apply_window(self, mesh: TetMesh, window: GreyWindow = GreyWindow()) -> np.ndarray:
        """Return the values (I, J, K), mapped to 0 .. 1 by a grey value window on the brain `mesh` (same coordinates).

        Values that are not finite or far too bright for tissue are replaced by the brain's median.

        Raises
        ------
        InputError
            The volume has no finite values in the brain.
        """
        corners, inverse = mesh.nodes[mesh.tets], np.linalg.inv(self.affine)
        index = np.rint(corners.mean(axis=1) @ inverse[:3, :3].T + inverse[:3, 3])
        there = ((index >= 0) & (index < self.values.shape)).all(axis=1)
        found = self.values[tuple(index[there].astype(int).T)].astype(np.float64)
        known = np.isfinite(found)
        if not known.any():
            raise InputError("the T1 volume has no finite values in the brain: give one in the labels' own space.")
        found, size = found[known], mesh.volumes[there][known]
        order = np.argsort(found, kind="stable")
        share = (np.cumsum(size[order]) - 0.5 * size[order]) / size.sum()
        low, middle, high = np.interp([0.01 * window.low_percent, 0.5, 0.01 * window.high_percent], share, found[order])
        values = self.values.astype(np.float64)
        values[~(np.isfinite(values) & (values <= high + window.max_excess * (high - low)))] = middle
        if high - low <= GREY_TOLERANCE * max(abs(low), abs(high)):
            return np.full(values.shape, window.flat_grey, np.float32)
        grey = window.low_grey + (window.high_grey - window.low_grey) * (values - low) / (high - low)
        return np.clip(grey, 0.0, 1.0).astype(np.float32)


def to_intensity_path(mesh: str | Path) -> Path:
    """Return the path of a mesh file's intensities: MESH.t1.nii.gz next to MESH.vtu."""
    return Path(mesh).with_suffix(".t1.nii.gz")


def write_intensity(path: str | Path, intensity: Intensity) -> None:
    """Write 8-bit intensities as NIfTI in millimetres (RAS), atomically.

    Raises
    ------
    InputError
        The folder is not writable.
    """
    with write_atomically(path, ".gz") as partial:
        partial.write_bytes(encode_intensity(intensity))


def encode_intensity(intensity: Intensity) -> bytes:
    """Return the bytes of a .nii.gz in millimetres (RAS); equal volumes have equal bytes."""
    import nibabel

    image = nibabel.Nifti1Image(intensity.values, np.diag([1e3, 1e3, 1e3, 1.0]) @ intensity.affine)
    image.header.set_xyzt_units("mm")
    image.header["descrip"] = b"sulcus: RAS, mm"
    return gzip.compress(image.to_bytes(), mtime=0)


def read_intensity(path: str | Path, spec: VoxelSpec = DEFAULT_VOXELS) -> Intensity:
    """Read a grey value volume that `write_intensity` wrote, or a scan of a patient. Non-finite voxels are kept.

    Raises
    ------
    InputError
        The file is missing, unreadable, or not a volume.
    """
    volume = read_volume(path, spec, require_finite=False)
    return Intensity(volume.values, volume.affine)

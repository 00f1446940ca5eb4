"""T1 intensities beside a mesh: a small NIfTI volume in the mesh's own frame, sampled at material points."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import InputError
from ..runtime.atomic_files import written_whole
from .nifti import read_volume

HEADER = 348  # bytes of NIfTI
SIGNED = b"sulcus: intensities beside a mesh"
"""By which what was written here is distinguished from a user's own scan."""


@dataclass(frozen=True)
class Crop:
    """What of a scan is kept beside a mesh.

    Parameters
    ----------
    margin
        [m] round what is looked at: a camera sees beyond the craniotomy's rim.
    brightest
        Per cent of the voxels in the crop are at most white: the few brightest are vessels, and would darken the rest.
    """

    margin: float = 0.015
    brightest: float = 99.5


@dataclass(frozen=True, eq=False)
class Intensity:
    """Grey values (I, J, K), and the affine (4, 4) from voxel indices to metres in the mesh's RAS frame."""

    values: np.ndarray
    affine: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) in [0, 1] at points (n, 3) [m]: trilinear, 8-bit grey over 255, zero outside the volume."""
        inverse = np.linalg.inv(self.affine)
        index = inverse[:3, :3] @ points.T + inverse[:3, 3:]
        return ndimage.map_coordinates(self.values, index, order=1, mode="constant", output=np.float64) / 255.0

    def around(self, points: np.ndarray, crop: Crop = Crop()) -> Intensity:
        """The part round the box of points (n, 3) [m], as 8-bit grey: black is 0, white the brightest.

        Raises
        ------
        InputError
            A volume that does not reach there.
        """
        inverse = np.linalg.inv(self.affine)
        index = points @ inverse[:3, :3].T + inverse[:3, 3]
        reach = crop.margin / np.linalg.norm(self.affine[:3, :3], axis=0)
        low = np.maximum(np.floor(index.min(axis=0) - reach), 0).astype(int)
        high = np.minimum(np.ceil(index.max(axis=0) + reach) + 1, self.values.shape).astype(int)
        if (high <= low).any():
            raise InputError("the T1 volume does not cover the craniotomy: give one in the labels' own space.")
        part = self.values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].astype(np.float64)
        white = float(np.percentile(part, crop.brightest))
        if white <= 0.0:
            raise InputError("the T1 volume is black at the craniotomy: give one in the labels' own space.")
        affine = self.affine.copy()
        affine[:3, 3] += self.affine[:3, :3] @ low
        return Intensity(np.rint(255.0 * np.clip(part / white, 0.0, 1.0)).astype(np.uint8), affine)


def sidecar(mesh: str | Path) -> Path:
    """Where the intensities of a mesh file lie: MESH.t1.nii.gz beside MESH.vtu."""
    return Path(mesh).with_suffix(".t1.nii.gz")


def write_intensity(path: str | Path, intensity: Intensity) -> None:
    """Write 8-bit intensities as NIfTI in millimetres (RAS); the file appears whole or not at all.

    Raises
    ------
    InputError
        A folder that cannot be written to.
    """
    import nibabel

    affine = np.diag([1e3, 1e3, 1e3, 1.0]) @ intensity.affine
    image = nibabel.Nifti1Image(intensity.values, affine)
    image.header.set_xyzt_units("mm")
    image.header["descrip"] = SIGNED
    with written_whole(path, ".gz") as partial:
        nibabel.save(image, partial)


def is_sidecar(path: str | Path) -> bool:
    """Whether a file is one that `write_intensity` wrote; OSError where it cannot be read."""
    with gzip.open(path, "rb") as file:
        return SIGNED in file.read(HEADER)


def read_intensity(path: str | Path) -> Intensity:
    """Read a volume of grey values: what `write_intensity` wrote, or a patient's scan.

    Raises
    ------
    InputError
        A file that is missing, unreadable, or not a volume.
    """
    volume = read_volume(path)
    return Intensity(volume.values, volume.affine)

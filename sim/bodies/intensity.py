"""T1 intensities beside a mesh: a small NIfTI volume in the mesh's own frame, sampled at material points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from ..runtime.atomic_files import write_atomically
from .volume import read_volume
from .voxels import OF_BRAINS, Voxels

# Grey values that differ by less than this share of them are one.
ALIKE = 1e-6


@dataclass(frozen=True)
class Window:
    """Which grey values of a brain are dark and which are light, whatever a scanner's scale and zero are.

    Parameters
    ----------
    low, high
        Per cent of the brain, by volume, that is darker: few voxels, such as vessels, do not shift them.
    dark, light
        In 0 .. 1: what these two become. What is beyond goes on in the same way, up to 0 and 1.
    beyond
        What is brighter than `high` by so many times the difference of the two is no tissue: a vessel with contrast
        agent, fat, or a voxel that is wrong.
    plain
        What all becomes where the brain has one grey value.
    """

    low: float = 5.0
    high: float = 90.0
    dark: float = 0.3
    light: float = 0.97
    beyond: float = 1.0
    plain: float = 0.8


KEPT = Window(dark=0.25, light=0.75)
"""That of the file beside a mesh: it keeps what is darker and lighter than nearly all of the brain."""


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

    def around(self, points: np.ndarray, mesh: TetMesh, margin: float = 0.015) -> Intensity:
        """Return the part round the box of points (n, 3) [m], with a margin [m], in the 8-bit grey of `KEPT`.

        Raises
        ------
        InputError
            A volume that does not reach there, or has no numbers in the brain.
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
        return Intensity(np.rint(255.0 * part.apply_window(mesh, KEPT)).astype(np.uint8), affine)

    def apply_window(self, mesh: TetMesh, window: Window = Window()) -> np.ndarray:
        """Return the values (I, J, K) float32 in 0 .. 1 by a window on the brain, a mesh in the same frame.

        What is no number, or far too bright for tissue, becomes the brain's median.

        Raises
        ------
        InputError
            A volume that has no finite numbers in the brain.
        """
        corners = mesh.nodes[mesh.tets]
        inverse = np.linalg.inv(self.affine)
        index = np.rint(corners.mean(axis=1) @ inverse[:3, :3].T + inverse[:3, 3])
        there = ((index >= 0) & (index < self.values.shape)).all(axis=1)
        found = self.values[tuple(index[there].astype(int).T)].astype(np.float64)
        known = np.isfinite(found)
        if not known.any():
            raise InputError("the T1 volume has no numbers in the brain: give one in the labels' own space.")
        found, size = found[known], mesh.volumes[there][known]
        order = np.argsort(found, kind="stable")
        share = (np.cumsum(size[order]) - 0.5 * size[order]) / size.sum()
        low, middle, high = np.interp([0.01 * window.low, 0.5, 0.01 * window.high], share, found[order])
        values = self.values.astype(np.float64)
        values[~(np.isfinite(values) & (values <= high + window.beyond * (high - low)))] = middle
        if high - low <= ALIKE * max(abs(low), abs(high)):
            return np.full(values.shape, window.plain, np.float32)
        grey = window.dark + (window.light - window.dark) * (values - low) / (high - low)
        return np.clip(grey, 0.0, 1.0).astype(np.float32)


def to_intensity_path(mesh: str | Path) -> Path:
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
    image.header["descrip"] = b"sulcus: intensities beside a mesh"
    with write_atomically(path, ".gz") as partial:
        nibabel.save(image, partial)


def read_intensity(path: str | Path, voxels: Voxels = OF_BRAINS) -> Intensity:
    """Read a volume of grey values: what `write_intensity` wrote, or a patient's scan.

    Raises
    ------
    InputError
        A file that is missing, unreadable, or not a volume. Voxels without a number are kept.
    """
    volume = read_volume(path, voxels, finite=False)
    return Intensity(volume.values, volume.affine)

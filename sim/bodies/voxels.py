"""A volume of voxels as it is read from a file of any format, and what voxels a volume of a brain may have."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

REMEDY = "Give one three-dimensional volume (.nii, .nii.gz, .mgz, .mgh, .nrrd, .seg.nrrd or .nhdr)."
LPS = np.array([-1.0, -1.0, 1.0])
"""What makes RAS of LPS, and the other way."""
# What lies behind the voxels and is read for the checksum after them [bytes], and what is read at once.
SURPLUS, PIECE = 2**24, 2**20
# Bytes of a file whose name does not say how it is packed: it is unpacked in memory.
MOST_UNPACKED = 2**31


@dataclass(frozen=True)
class Voxels:
    """Which voxels a volume of a brain may have.

    Parameters
    ----------
    finest, coarsest
        [m] Edges: no scanner of a brain resolves less, and larger voxels do not show its surface.
    same_place
        [m] An sform and a qform that place a voxel less far apart differ by round-off.
    axes
        Directions of the axes of a NIfTI file that states none, such as RAS or LPS; empty: it is rejected.
    """

    finest: float = 1e-5
    coarsest: float = 6e-3
    same_place: float = 1e-3
    axes: str = ""

    @property
    def ignored_axes(self) -> tuple[str, ...]:
        """A note for a file that states its orientation itself, where `axes` are given."""
        return (f"its own orientation is used: axes {self.axes} are ignored",) if self.axes else ()


OF_BRAINS = Voxels()
"""What a scanner of brains makes."""


@dataclass(frozen=True)
class Segment:
    """What a segmentation calls a label: its name, the layer that it lies in, and its number there."""

    name: str
    layer: int
    value: int


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxels, and where they lie.

    Parameters
    ----------
    values
        (I, J, K), or (I, J, K, L) where a segmentation has several layers.
    affine
        (4, 4) from their indices to metres (RAS).
    notes
        Sentences about what had to be assumed.
    segments
        What the file calls its labels, if it does.
    """

    values: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Where the voxels of a file lie: how many there are along each axis, and (4, 4) from indices to metres (RAS)."""

    path: Path
    shape: tuple[int, ...]
    affine: np.ndarray


def open_volume(path: Path) -> Any:
    """Return a file opened at its first byte, unpacked as its content says, whatever it is called.

    Raises
    ------
    InputError
        An archive of several files.
    """
    return _opener(path)(path, "rb")


def unpack_file(path: Path) -> str | BytesIO:
    """What nibabel opens a file by: its name where that says how the content is packed, else its unpacked bytes."""
    named = gzip.open if path.name.lower().endswith(("gz", "mgz")) else open
    if _opener(path) is named:
        return str(path)
    with open_volume(path) as file:
        return BytesIO(file.read(MOST_UNPACKED))


def _opener(path: Path) -> Callable[..., Any]:
    with path.open("rb") as file:
        start = file.read(4)
    if start == b"PK\3\4":
        raise InputError(f"{path}: is a ZIP archive: unpack it, and give the file in it.")
    packers = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zX": lzma.open}
    return next((opener for magic, opener in packers.items() if start.startswith(magic)), open)


def check_volume(path: Path, volume: Volume, voxels: Voxels, finite: bool, layered: bool) -> Volume:
    """Return the volume without axes of one voxel beyond the third, if it is one of numbers with a place.

    `layered` lets several layers of a segmentation pass, as (I, J, K, L).

    Raises
    ------
    InputError
        Colours or complex numbers; a slice or several volumes; segments that overlap, unless `layered`. Unless not
        `finite`, values that are no numbers. An affine that is singular, and voxels too fine or too coarse.
    """
    values, affine = volume.values, volume.affine
    shape = " x ".join(map(str, values.shape))
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: holds colours or complex numbers ({values.dtype}), not plain ones. {REMEDY}")
    if not layered and volume.segments and values.ndim == 4 and values.shape[3] > 1:
        raise InputError(
            f"{path}: its segments overlap, in {values.shape[3]} layers, so it is no label map. Export them as a label "
            "map (.nii.gz): there each voxel has one label."
        )
    most = values.shape[3] if layered and volume.segments and values.ndim == 4 else 1
    if values.ndim < 3 or min(values.shape[:3]) < 2 or max(values.shape[3:], default=1) > most:
        raise InputError(f"{path}: measures {shape} voxels, which is not one volume. {REMEDY}")
    if finite and not np.isfinite(values).all():
        lacking = int((~np.isfinite(values)).sum())
        raise InputError(f"{path}: {lacking} of its numbers are not finite. Replace them by 0.")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) <= 1e-6 * spacing.prod():
        raise InputError(
            f"{path}: its affine is singular, so its voxels have no place. Export it with its orientation."
        )
    if spacing.min() < voxels.finest:
        raise InputError(
            f"{path}: its voxels measure {spacing.min() * 1e3:.3g} mm along an axis; {voxels.finest * 1e3:g} mm is the "
            "least. Set the voxel size, or resample it."
        )
    if spacing.max() > voxels.coarsest:
        voxel = " x ".join(f"{edge * 1e3:.3g}" for edge in spacing)
        raise InputError(
            f"{path}: its voxels measure {voxel} mm; {voxels.coarsest * 1e3:g} mm is the most that shows a brain."
        )
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    return Volume(values, affine, volume.notes, volume.segments)

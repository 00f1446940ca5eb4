"""Voxel volume read from a file, and limits of a brain volume."""

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
"""Sign of each coordinate in the conversion between LPS and RAS."""
SURPLUS = 2**24  # maximum data after the voxels, read for a checksum [bytes]
BLOCK = 2**20  # block size of reading [bytes]
# Maximum decompressed size of a file whose suffix does not show its compression [bytes].
MAX_UNPACKED_BYTES = 2**31


@dataclass(frozen=True)
class VoxelSpec:
    """Limits and options of a brain volume.

    Parameters
    ----------
    min_edge, max_edge
        Limits of the voxel edges [m]: no brain scanner has finer voxels; coarser voxels do not resolve the surface.
    max_sform_difference
        Maximum distance [m] between the positions of a voxel by sform and by qform; only round-off is allowed.
    axes
        Axis directions of NIfTI files without orientation, such as RAS or LPS; if empty, such files are rejected.
    """

    min_edge: float = 1e-5
    max_edge: float = 6e-3
    max_sform_difference: float = 1e-3
    axes: str = ""

    @property
    def ignored_axes_note(self) -> tuple[str, ...]:
        """Note that `axes` are ignored because the file has an orientation; () if `axes` is empty."""
        return (f"its own orientation is used: axes {self.axes} are ignored",) if self.axes else ()


DEFAULT_VOXELS = VoxelSpec()
"""Default limits and options, for brain scanners."""


@dataclass(frozen=True)
class Segment:
    """Segment of a segmentation: name, layer, and label value in that layer."""

    name: str
    layer: int
    value: int


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel values and their positions.

    Parameters
    ----------
    values
        Values (I, J, K), or (I, J, K, L) of a segmentation with L layers.
    affine
        Affine (4, 4) from voxel indices to metres (RAS).
    notes
        Notes for the user on assumptions.
    segments
        Named segments; () if the file has no segments.
    """

    values: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Voxel grid of a file: number of voxels along each axis, and affine (4, 4) from indices to metres (RAS)."""

    path: Path
    shape: tuple[int, ...]
    affine: np.ndarray


def open_volume(path: Path) -> Any:
    """Return the file opened for reading; decompression depends on its content, not on its name.

    Raises
    ------
    InputError
        The file is an archive of several files.
    """
    return _find_opener(path)(path, "rb")


def unpack_file(path: Path) -> str | BytesIO:
    """Return the file name if its suffix matches the compression, as nibabel requires; else the decompressed bytes."""
    named = gzip.open if path.name.lower().endswith(("gz", "mgz")) else open
    if _find_opener(path) is named:
        return str(path)
    with open_volume(path) as file:
        return BytesIO(file.read(MAX_UNPACKED_BYTES))


def _find_opener(path: Path) -> Callable[..., Any]:
    with path.open("rb") as file:
        start = file.read(4)
    if start == b"PK\3\4":
        raise InputError(f"{path}: is a ZIP archive: unpack it, and give the file in it.")
    packers = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zX": lzma.open}
    return next((opener for magic, opener in packers.items() if start.startswith(magic)), open)


def check_volume(path: Path, volume: Volume, spec: VoxelSpec, require_finite: bool, allow_layers: bool) -> Volume:
    """Return a valid volume, without singleton axes after the third axis.

    `allow_layers` accepts several layers of a segmentation, as (I, J, K, L).

    Raises
    ------
    InputError
        The values are colours, complex numbers, a slice, several volumes, overlapping segments (unless `allow_layers`),
        or not finite (if `require_finite`). The affine is singular, or voxels are too fine or too coarse.
    """
    values, affine = volume.values, volume.affine
    shape = " x ".join(map(str, values.shape))
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: holds colours or complex numbers ({values.dtype}), not plain ones. {REMEDY}")
    if not allow_layers and volume.segments and values.ndim == 4 and values.shape[3] > 1:
        raise InputError(
            f"{path}: its segments overlap, in {values.shape[3]} layers, so it is no label map. Export them as a label "
            "map (.nii.gz): there each voxel has one label."
        )
    most = values.shape[3] if allow_layers and volume.segments and values.ndim == 4 else 1
    if values.ndim < 3 or min(values.shape[:3]) < 2 or max(values.shape[3:], default=1) > most:
        raise InputError(f"{path}: measures {shape} voxels, which is not one volume. {REMEDY}")
    if require_finite and not np.isfinite(values).all():
        lacking = int((~np.isfinite(values)).sum())
        raise InputError(f"{path}: {lacking} of its numbers are not finite. Replace them by 0.")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) <= 1e-6 * spacing.prod():
        raise InputError(
            f"{path}: its affine is singular, so its voxels have no position. Export it with its orientation."
        )
    if spacing.min() < spec.min_edge:
        raise InputError(
            f"{path}: its voxels measure {spacing.min() * 1e3:.3g} mm along an axis; "
            f"{spec.min_edge * 1e3:g} mm is the least. Set the voxel size, or resample it."
        )
    if spacing.max() > spec.max_edge:
        voxel = " x ".join(f"{edge * 1e3:.3g}" for edge in spacing)
        raise InputError(
            f"{path}: its voxels measure {voxel} mm; {spec.max_edge * 1e3:g} mm is the maximum for a brain."
        )
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    return Volume(values, affine, volume.notes, volume.segments)

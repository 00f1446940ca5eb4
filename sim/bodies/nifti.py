"""NIfTI volumes as they come: any affine, in metres."""

from __future__ import annotations

import gzip
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..runtime.file_limits import MOST_VOXELS
from ..runtime.outside_files import path_of, read_as

if TYPE_CHECKING:
    from nibabel.nifti1 import Nifti1Image

METRES = {"mm": 1e-3, "unknown": 1e-3, "meter": 1.0, "micron": 1e-6}
# Bytes read at once, and bytes behind the voxels that are read for the checksum after them.
PIECE, SURPLUS = 2**20, 2**24
REMEDY = "Give one three-dimensional NIfTI volume (.nii or .nii.gz)."


@dataclass(frozen=True)
class Voxels:
    """Which voxels a volume of a brain may have.

    Parameters
    ----------
    finest, coarsest
        [m] Edges: no scanner of a brain resolves less, and larger voxels do not show its surface.
    same_place
        [m] An sform and a qform that place a voxel less far apart differ by round-off.
    """

    finest: float = 1e-5
    coarsest: float = 6e-3
    same_place: float = 1e-3


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxels (I, J, K), the affine (4, 4) from their indices to metres (RAS), and what had to be assumed."""

    values: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...]


def read_volume(path: str | Path, voxels: Voxels = Voxels(), finite: bool = True) -> Volume:
    """Read one volume of numbers from a NIfTI file; unless `finite` is off, all of them must be finite.

    Raises
    ------
    InputError
        A path that is no readable NIfTI file, or a file that ends before its voxels do. Several volumes, a slice,
        colours or complex numbers. Values or a slope that are not finite. An affine that is singular. Voxels that are
        too coarse or too fine, or too many of them.
    """
    import nibabel

    path = path_of(path)
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}. {REMEDY}")
    if not path.name.lower().endswith((".nii", ".nii.gz")):
        raise InputError(f"{path}: is not called .nii or .nii.gz. {REMEDY}")
    with read_as(path, "NIfTI", REMEDY):
        image = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Image):
            raise InputError(f"{path}: is no NIfTI volume in one file. {REMEDY}")
        _demand_held(path, image)
        values = np.asanyarray(image.dataobj)
        unit = str(image.header.get_xyzt_units()[0])
        affine = np.array(image.affine, np.float64)
        metre = METRES.get(unit, 1e-3)
        affine[:3] *= metre
        _check(path, values, affine, voxels, finite)
        while values.ndim > 3:
            values = values[..., 0]
        return Volume(values, affine, _assumed(image, metre, voxels.same_place))


def _demand_held(path: Path, image: Nifti1Image) -> None:
    """Refuse a file that declares more voxels than may be, or more than it has: no memory is taken before."""
    voxels = math.prod(image.shape)
    if voxels > MOST_VOXELS:
        raise InputError(f"{path}: has {voxels:.3g} voxels, and {MOST_VOXELS:.3g} are the most. Resample it.")
    with image.file_map["image"].get_prepare_fileobj("rb") as file:
        header = type(image.header).from_fileobj(file)  # the image's own has forgotten them
    slope, shift = float(header["scl_slope"]), float(header["scl_inter"])
    if not math.isfinite(slope) or not math.isfinite(shift):
        raise InputError(
            f"{path}: its values have the slope {slope:g} and the intercept {shift:g}, which are no numbers. Export it "
            "again."
        )
    needed = int(header["vox_offset"]) + voxels * header.get_data_dtype().itemsize
    held = 0
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
        while piece := file.read(PIECE):  # to its end, where gzip has its checksum
            held += len(piece)
            if held > needed + SURPLUS:
                break
    if held < needed:
        raise InputError(f"{path}: ends after {held:,} of {needed:,} bytes. Copy or export it again.")


def _assumed(image: Nifti1Image, metre: float, same: float) -> tuple[str, ...]:
    """What had to be assumed about the place of an image whose affine is in units of `metre` [m]."""
    sform = image.get_sform(coded=True)[0]
    try:
        qform = image.get_qform(coded=True)[0]
    except ValueError:  # no rotation is stored there; where the sform is good, nibabel does not look at it
        qform = None
    if sform is None and qform is None:
        return ("has neither sform nor qform: its axes are taken to point right, anterior and superior",)
    if sform is None or qform is None:
        return ()
    corners = np.stack([*np.ndindex(2, 2, 2)]) * (np.array(image.shape[:3]) - 1)
    apart = metre * np.linalg.norm(corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3], axis=1).max()
    if apart <= same:
        return ()
    return (f"its sform and qform place it up to {apart * 1e3:.3g} mm apart: the sform is taken",)


def _check(path: Path, values: np.ndarray, affine: np.ndarray, voxels: Voxels, finite: bool) -> None:
    shape = " x ".join(map(str, values.shape))
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: holds colours or complex numbers ({values.dtype}), not plain ones. {REMEDY}")
    if values.ndim < 3 or min(values.shape[:3]) < 2 or max(values.shape[3:], default=1) > 1:
        raise InputError(f"{path}: measures {shape} voxels, which is not one volume. {REMEDY}")
    if finite and not np.isfinite(values).all():
        raise InputError(f"{path}: {int((~np.isfinite(values)).sum())} voxels are not finite. Replace them by 0.")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) <= 1e-6 * spacing.prod():
        raise InputError(f"{path}: its affine is singular, so its voxels have no place. Set the sform or qform.")
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

"""NIfTI volumes and FreeSurfer's as they come: any affine, in metres."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..runtime.file_limits import MOST_VOXELS
from .voxels import PIECE, REMEDY, SURPLUS, Volume, Voxels

if TYPE_CHECKING:
    from nibabel.freesurfer.mghformat import MGHImage
    from nibabel.nifti1 import Nifti1Image

METRES = {"mm": 1e-3, "unknown": 1e-3, "meter": 1.0, "micron": 1e-6}


def read_nifti(path: Path, voxels: Voxels) -> Volume:
    """The voxels of a NIfTI file of one part.

    Raises
    ------
    InputError
        Another file, one that ends before its voxels do or that declares too many, a slope that is no number. nibabel's
        own exceptions of a damaged one.
    """
    import nibabel

    image = nibabel.load(path)
    if not isinstance(image, nibabel.Nifti1Image):
        raise InputError(f"{path}: is no NIfTI volume in one file. {REMEDY}")
    with image.file_map["image"].get_prepare_fileobj("rb") as file:
        header = type(image.header).from_fileobj(file)  # the image's own has forgotten them
    slope, shift = float(header["scl_slope"]), float(header["scl_inter"])
    _demand_few(path, image.shape)
    if not math.isfinite(slope) or not math.isfinite(shift):
        raise InputError(
            f"{path}: its values have the slope {slope:g} and the intercept {shift:g}, which are no numbers. Export it "
            "again."
        )
    needed = int(header["vox_offset"]) + math.prod(image.shape) * header.get_data_dtype().itemsize
    _demand_held(path, needed, path.name.lower().endswith(".gz"))
    metre = METRES.get(str(image.header.get_xyzt_units()[0]), 1e-3)
    return Volume(np.asanyarray(image.dataobj), _affine(image, metre), _assumed(image, metre, voxels.same_place))


def read_mgh(path: Path, voxels: Voxels) -> Volume:
    """The voxels of a volume that FreeSurfer wrote; its file is in millimetres, and `voxels` say nothing about it.

    Raises
    ------
    InputError
        A file that ends before its voxels do, declares too many, or does not state its orientation. nibabel's own
        exceptions of a damaged one.
    """
    import nibabel

    image = nibabel.MGHImage.from_filename(path)
    header = image.header
    shape = tuple(map(int, image.shape))
    _demand_few(path, shape)
    needed = header.get_data_offset() + math.prod(shape) * header.get_data_bytespervox()
    packed = path.name.lower().endswith(".mgz")
    _demand_held(path, needed, packed)
    with gzip.open(path) if packed else path.open("rb") as file:
        flag = file.read(30)[28:]  # nibabel's own header has an orientation always
    if flag != b"\x00\x01":
        raise InputError(
            f"{path}: does not state how its axes lie in the head (goodRASFlag 0). Set its orientation, "
            "for instance with mri_convert, and give that file."
        )
    return Volume(np.asanyarray(image.dataobj), _affine(image, 1e-3))


def _affine(image: Nifti1Image | MGHImage, metre: float) -> np.ndarray:
    affine = np.array(image.affine, np.float64)
    affine[:3] *= metre
    return affine


def _demand_few(path: Path, shape: tuple[int, ...]) -> None:
    """Refuse a file that declares more voxels than may be: no memory is taken before."""
    voxels = math.prod(shape)
    if voxels > MOST_VOXELS:
        raise InputError(f"{path}: has {voxels:.3g} voxels, and {MOST_VOXELS:.3g} are the most. Resample it.")


def _demand_held(path: Path, needed: int, packed: bool) -> None:
    """Refuse a file that has fewer bytes than it declares: no memory is taken before."""
    held = 0
    with gzip.open(path) if packed else path.open("rb") as file:
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

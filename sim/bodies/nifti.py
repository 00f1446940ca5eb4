"""Reader for NIfTI and FreeSurfer volumes with any affine, in metres."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..runtime.file_limits import MAX_VOXELS
from .voxels import BLOCK, REMEDY, SURPLUS, Volume, VoxelSpec, open_volume, unpack_file

if TYPE_CHECKING:
    from nibabel.fileholders import FileHolder
    from nibabel.freesurfer.mghformat import MGHImage
    from nibabel.nifti1 import Nifti1Image

# Tolerance by which a quaternion's squared length may exceed 1.
NORM_TOLERANCE = 1e-3
METRES = {"mm": 1e-3, "unknown": 1e-3, "meter": 1.0, "micron": 1e-6}  # length units [m]


def read_nifti(path: Path, spec: VoxelSpec) -> Volume:
    """Return the volume in a single-file NIfTI.

    Raises
    ------
    InputError
        The file has another format, is truncated, declares too many voxels, or has a non-finite slope. For damaged
        files, exceptions of nibabel also occur.
    """
    image = load_nifti(path)
    with open_volume(path) as file:
        header = type(image.header).from_fileobj(file, check=False)  # the image's header lacks slope and size
    slope, shift = float(header["scl_slope"]), float(header["scl_inter"])
    _check_voxel_count(path, image.shape)
    if not math.isfinite(slope) or not math.isfinite(shift):
        raise InputError(
            f"{path}: its values have the slope {slope:g} and the intercept {shift:g}, which are no numbers. Export it "
            "again."
        )
    needed = int(header["vox_offset"]) + math.prod(image.shape) * header.get_data_dtype().itemsize
    _check_file_length(path, needed)
    metre = METRES.get(str(image.header.get_xyzt_units()[0]), 1e-3)
    affine, notes = _read_affine(path, image, metre, spec)
    size = np.asarray(header["pixdim"], np.float64)[1:4]
    if image.header["sform_code"] == 0 and not (size > 0.0).all():
        raise InputError(f"{path}: its voxel size is {size} (pixdim): every edge must be above 0.")
    return Volume(np.asanyarray(image.dataobj), affine, notes)


def load_nifti(path: Path) -> Nifti1Image:
    """Return the image of a single-file NIfTI, compressed or not, whatever its suffix.

    Raises
    ------
    InputError
        The file has another format, its qform is not a rotation, or nibabel rejects the header. For damaged files,
        other exceptions of nibabel also occur.
    """
    import nibabel
    from nibabel.imageglobals import LoggingOutputSuppressor
    from nibabel.spatialimages import HeaderDataError

    with open_volume(path) as file:
        start = file.read(540)  # size of a NIfTI-2 header
    two = start[4:8] in (b"n+2\0", b"ni2\0")
    if not two and 348 not in (int.from_bytes(start[:4], "little"), int.from_bytes(start[:4], "big")):
        raise ValueError("no header of NIfTI")
    if not two and start[344:348] != b"n+1\0":
        raise InputError(f"{path}: is no NIfTI volume in one file. {REMEDY}")
    kind = nibabel.Nifti2Image if two else nibabel.Nifti1Image
    header = kind.header_class(start[: kind.header_class.template_dtype.itemsize], check=False)
    over = sum(float(header[f"quatern_{axis}"]) ** 2 for axis in "bcd") - 1.0
    if over > NORM_TOLERANCE and int(header["qform_code"]) > 0 >= int(header["sform_code"]):
        raise InputError(
            f"{path}: its qform has a quaternion of length {(over + 1.0) ** 0.5:.4g}, which is no rotation: the length "
            "must be 1. Export it again, with its orientation."
        )
    if 0.0 < over <= NORM_TOLERANCE:  # half a turn, as the reference code assumes; nibabel allows single round-off
        rounded = type("Rounded", (kind.header_class,), {"quaternion_threshold": 2.0 * NORM_TOLERANCE})
        kind = type("RoundedImage", (kind,), {"header_class": rounded})
    try:
        with LoggingOutputSuppressor():  # nibabel logs repaired fields
            return kind.from_file_map({"image": _build_file_holder(path)})
    except HeaderDataError as error:
        raise InputError(f"{path}: nibabel reports `{error}`. {REMEDY}") from error


def _build_file_holder(path: Path) -> FileHolder:
    from nibabel.fileholders import FileHolder

    given = unpack_file(path)
    return FileHolder(given) if isinstance(given, str) else FileHolder(fileobj=given)


def read_mgh(path: Path, spec: VoxelSpec) -> Volume:
    """Return the volume in a FreeSurfer file, whose unit is millimetres; the options `spec` are ignored.

    Raises
    ------
    InputError
        The file is truncated, declares too many voxels, or has no orientation. For damaged files, exceptions of
        nibabel also occur.
    """
    import nibabel

    image = nibabel.MGHImage.from_file_map({"image": _build_file_holder(path)})
    header, shape = image.header, tuple(map(int, image.shape))
    _check_voxel_count(path, shape)
    needed = header.get_data_offset() + math.prod(shape) * header.get_data_bytespervox()
    _check_file_length(path, needed)
    with open_volume(path) as file:
        flag = file.read(30)[28:]  # nibabel's header always has an orientation
    if flag != b"\x00\x01":
        raise InputError(
            f"{path}: does not state how its axes lie in the head (goodRASFlag 0). Set its orientation, "
            "for instance with mri_convert, and give that file."
        )
    return Volume(np.asanyarray(image.dataobj), _scale_affine(image, 1e-3))


def _scale_affine(image: Nifti1Image | MGHImage, unit: float) -> np.ndarray:
    affine = np.array(image.affine, np.float64)
    affine[:3] *= unit
    return affine


def _check_voxel_count(path: Path, shape: tuple[int, ...]) -> None:
    """Reject a file that declares more than `MAX_VOXELS` voxels, before memory is allocated."""
    voxels = math.prod(shape)
    if voxels > MAX_VOXELS:
        raise InputError(f"{path}: has {voxels:.3g} voxels; the maximum is {MAX_VOXELS:.3g}. Resample it.")


def _check_file_length(path: Path, length: int) -> None:
    """Reject a file with fewer bytes than it declares, before memory is allocated."""
    held = 0
    with open_volume(path) as file:
        while piece := file.read(BLOCK):  # to the end, where gzip stores its checksum
            held += len(piece)
            if held > length + SURPLUS:
                break
    if held < length:
        raise InputError(f"{path}: ends after {held:,} of {length:,} bytes. Copy or export it again.")


def _read_affine(path: Path, image: Nifti1Image, unit: float, voxels: VoxelSpec) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the affine (4, 4) from voxel indices to metres (RAS), and notes; the image has the unit `unit` [m].

    Raises
    ------
    InputError
        The image has no orientation and `voxels` do not give one, or the axes are invalid.
    """
    sform = image.get_sform(coded=True)[0]
    try:
        qform = image.get_qform(coded=True)[0]
    except ValueError:  # the qform is not a rotation; nibabel ignores it if the sform is valid
        qform = None
    if sform is None and qform is None:
        return _build_centred_affine(path, image, unit, voxels.axes), ()
    if sform is None or qform is None:
        return _scale_affine(image, unit), voxels.ignored_axes_note
    corners = np.stack([*np.ndindex(2, 2, 2)]) * (np.array(image.shape[:3]) - 1)
    apart = unit * np.linalg.norm(corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3], axis=1).max()
    note = f"its sform and qform place it up to {apart * 1e3:.3g} mm apart: the sform is taken"
    if np.linalg.det(sform[:3, :3]) * np.linalg.det(qform[:3, :3]) < 0.0:
        note = "its sform and qform mirror each other: left and right are swapped in one of them. The sform is taken"
    elif sform[0, :3] @ qform[0, :3] < -0.5 * np.linalg.norm(sform[0, :3]) * np.linalg.norm(qform[0, :3]):
        note = (
            f"its sform and qform disagree on which side is left (up to {apart * 1e3:.3g} mm apart): left and right "
            "are swapped in one of them. The sform is taken"
        )
    return _scale_affine(image, unit), (
        *voxels.ignored_axes_note,
        note,
    ) if apart > voxels.max_sform_difference else voxels.ignored_axes_note


def _build_centred_affine(path: Path, image: Nifti1Image, unit: float, axes: str) -> np.ndarray:
    """Return the affine (4, 4) from indices to metres of a volume centred at the origin, with directions `axes`."""
    if not axes:
        raise InputError(
            f"{path}: has neither sform nor qform, so its left side is unknown. Export it with its orientation, or "
            "state where its axes point, such as --axes RAS or --axes LPS."
        )
    rows = [next((row for row, ends in enumerate(("LR", "PA", "IS")) if letter in ends), 3) for letter in axes.upper()]
    if sorted(rows) != [0, 1, 2]:
        raise InputError(f"axes {axes!r} are no directions: give three letters such as RAS or LPS.")
    affine = np.eye(4)
    affine[:3, :3] = 0.0
    for axis, (row, letter) in enumerate(zip(rows, axes.upper(), strict=True)):
        affine[row, axis] = unit * float(image.header.get_zooms()[axis]) * (1.0 if letter in "RAS" else -1.0)
    affine[:3, 3] = -0.5 * affine[:3, :3] @ (np.array(image.shape[:3]) - 1)
    return affine

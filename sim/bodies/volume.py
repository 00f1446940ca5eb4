"""Reader for voxel volumes of several formats with any affine; positions are in metres (RAS)."""

from dataclasses import replace
from pathlib import Path

from ..errors import InputError
from ..runtime.outside_files import to_path, wrap_errors
from .nifti import read_mgh, read_nifti
from .nrrd import read_nrrd
from .voxels import DEFAULT_VOXELS, REMEDY, Volume, VoxelSpec, check_volume

READERS = {
    ".nii": ("NIfTI", read_nifti),
    ".nii.gz": ("NIfTI", read_nifti),
    ".mgz": ("a FreeSurfer volume", read_mgh),
    ".mgh": ("a FreeSurfer volume", read_mgh),
    ".nrrd": ("NRRD", read_nrrd),
    ".nhdr": ("NRRD", read_nrrd),
}
"""Format name and reader by file suffix."""


def read_volume(
    path: str | Path, spec: VoxelSpec = DEFAULT_VOXELS, require_finite: bool = True, allow_layers: bool = False
) -> Volume:
    """Return the numeric volume in a file; if `require_finite`, all values must be finite.

    If `allow_layers`, the values of a segmentation may be (I, J, K, L), with L layers that overlap.

    Raises
    ------
    InputError
        The file is unreadable, truncated or of another format. It contains several volumes, only a slice, colours or
        complex numbers, or values or a slope that are not finite. The orientation is missing or the affine singular.
        Voxels are too coarse, too fine, or too many.
    """
    path = to_path(path)
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}. {REMEDY}")
    ending = next((one for one in READERS if path.name.lower().endswith(one)), None)
    if ending is None:
        raise InputError(f"{path}: unsupported file type; expected {', '.join(READERS)}. {REMEDY}")
    kind, read = READERS[ending]
    with wrap_errors(path, kind, REMEDY):
        volume = read(path, spec)
        if kind != "NIfTI":  # the NIfTI reader itself uses `axes` for files without orientation
            volume = replace(volume, notes=(*volume.notes, *spec.ignored_axes_note))
        return check_volume(path, volume, spec, require_finite, allow_layers)

"""Healthy heads other than the template: from a brain mask, or from the inner skull of fsaverage."""

from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..runtime.optional_packages import install_hint
from ..runtime.outside_files import wrap_errors
from .enclosed_voxels import rasterise_interior
from .head_masks import HeadMasks
from .intensity import Intensity, read_intensity
from .label_map import count_border
from .label_volume import fill_brain
from .template import MNI_CENTRE, HealthyHead, measure_centroid_and_volume, scale_affine
from .volume import read_volume

VIEW_CENTRE = (1e-3 * MNI_CENTRE[0], 1e-3 * MNI_CENTRE[1], 1e-3 * MNI_CENTRE[2])  # centre of the view [m]
INNER_SKULL = Path("data", "fsaverage", "fsaverage-inner_skull-bem.fif")
"""Path of the inner skull surface, relative to the package mne."""
VOXEL_SIZE = 1e-3
"""Voxel edge for the voxelised skull [m]."""
REMEDY = install_hint("heads")  # remedy of messages about the package mne


def build_masked_head(mask: Path, t1: Path | None = None, volume: float | None = None) -> HealthyHead:
    """Return the head whose brain is the nonzero voxels of a file, scaled about the brain's centroid to `volume` [m^3].

    `t1` is an intensity volume in the same space, scaled like the mask.

    Raises
    ------
    InputError
        `read_volume`, `read_intensity` or `fill_brain` rejects the input, or all voxels of the mask are 0.
    """
    read = read_volume(mask)
    brain = read.values != 0
    if not brain.any():
        raise InputError(f"{mask}: all voxels are 0: give a mask of the brain.")
    notes = list(read.notes)
    masks = HeadMasks(
        str(mask), "its voxels", brain, np.zeros_like(brain), read.affine, border_voxels=count_border(brain)
    )
    solid = fill_brain(masks, notes)
    healthy = HealthyHead(solid, read.affine, t1 and read_intensity(t1), VIEW_CENTRE, tuple(notes))
    return healthy if volume is None else _scale_head(healthy, volume)


def read_fsaverage_head(volume: float) -> HealthyHead:
    """Return the head of fsaverage, scaled to a `volume` [m^3]; the whole space inside the inner skull is brain.

    The brain surface coincides with the inner skull: there is no fluid between brain and skull, and there are no sulci.

    Raises
    ------
    InputError
        The package mne is missing, or does not contain the skull as one closed surface.
    """
    path = _find_skull_path()
    with wrap_errors(path, "one surface in FIF", "Reinstall its package."):
        (surface,) = import_module("mne").read_bem_surfaces(path, verbose="error")
    try:
        mask, affine = rasterise_interior(surface["rr"], surface["tris"], VOXEL_SIZE)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return _scale_head(HealthyHead(mask, affine, origin=VIEW_CENTRE), volume)


def _find_skull_path() -> Path:
    found = find_spec("mne")
    if found is None or not found.submodule_search_locations:
        raise InputError(f"fsaverage's skull is in the package mne, which is not installed. {REMEDY}")
    path = Path(found.submodule_search_locations[0]) / INNER_SKULL
    if not path.is_file():
        raise InputError(f"{path}: no such file, so this mne holds no skull of fsaverage. {REMEDY}")
    return path


def _scale_head(head: HealthyHead, volume: float) -> HealthyHead:
    centre, own = measure_centroid_and_volume(head.mask, head.affine)
    factor, grey = (volume / own) ** (1.0 / 3.0), head.intensity
    if grey is not None:
        grey = Intensity(grey.values, scale_affine(grey.affine, centre, factor, centre))
    return replace(head, affine=scale_affine(head.affine, centre, factor, centre), intensity=grey)

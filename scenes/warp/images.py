"""A patient's own images and label maps, as they would be now: on their own grids, as NIfTI."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np
from nibabel.arrayproxy import ArrayProxy
from scipy import ndimage

from sim.anatomy import Anatomy
from sim.bodies.label_map import are_whole
from sim.bodies.nifti import load_nifti
from sim.bodies.volume import READERS, Volume, read_volume
from sim.bodies.voxels import Voxels
from sim.errors import InputError
from sim.fields.grid import Grid
from sim.fields.warp_fields import WarpFields

from .doubts import doubts, index_of, shown
from .nrrd_files import DIGITS

SUFFIXES = (".seg.nrrd", *READERS)
ORDERS = {"nearest": 0, "linear": 1, "cubic": 3}
"""How values between voxels are had, and the degree of the spline."""
WHOLE = np.uint8, np.int16, np.uint16, np.int32
"""Types of whole numbers that every reader of NIfTI knows."""
DISPLACEMENT = 1006
"""NIfTI's intent: vectors in millimetres, RAS."""
# Voxels that move less [m] stay as they are.
STILL = 1e-8
# Slices that are looked at together: bounds the memory that it takes.
TOGETHER = 8


@dataclass(frozen=True, eq=False)
class Picture:
    """An image of a patient: its file, itself as NIfTI, its values (I, J, K) and their place; what seems wrong."""

    path: Path
    image: nibabel.Nifti1Image
    volume: Volume
    labels: bool
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Warped:
    """Of a warped image: its name, and voxels that moved, whose source lies outside of it, and that were cut away."""

    name: str
    moved: int
    outside: int
    gone: int


def read_picture(path: Path, anatomy: Anatomy, labels: bool, axes: str = "") -> Picture:
    """Read an image, or a label map, that shows the brain of an anatomy.

    Raises
    ------
    InputError
        As `read_volume`; an image that shows none of this brain; labels that are not whole numbers.
    """
    volume = read_volume(path, Voxels(axes=axes), finite=False)
    image = _as_nifti(path, volume)
    values = volume.values
    if labels and not are_whole(values):
        raise InputError(f"{path}: holds values that are not whole, so it is no label map. Give it by --image.")
    if shown(volume.affine, values.shape, anatomy) == 0.0:
        low, high = (1e3 * end for end in (anatomy.mesh.nodes.min(axis=0), anatomy.mesh.nodes.max(axis=0)))
        raise InputError(
            f"{path}: shows none of this brain, which reaches from {_mm(low)} to {_mm(high)} mm (RAS). Give an image "
            "in the space of the labels that the anatomy was made from, or register it to them first."
        )
    warnings = [*volume.notes, *doubts(values, volume.affine, labels, anatomy)]
    return Picture(path, image, volume, labels, tuple(warnings))


def _as_nifti(path: Path, volume: Volume) -> nibabel.Nifti1Image:
    """The image as its NIfTI file has it; of another format, the same values in the same place, whole ones whole."""
    if path.name.lower().endswith((".nii", ".nii.gz")):
        return load_nifti(path)
    values = np.nan_to_num(volume.values)
    with np.errstate(invalid="ignore"):
        whole = [kind for kind in WHOLE if np.array_equal(values, values.astype(kind))]
    values = values.astype(whole[0] if whole else np.float32)
    made = nibabel.Nifti1Image(values, volume.affine * [[1e3], [1e3], [1e3], [1.0]])
    made.header.set_xyzt_units("mm")
    return made


def warped_name(path: Path) -> str:
    """The name of a warped image: that of its file, with `_deformed`."""
    ending = next((end for end in SUFFIXES if path.name.lower().endswith(end)), "")
    return f"{path.name[: len(path.name) - len(ending)]}_deformed.nii.gz"


def write_warped(folder: Path, picture: Picture, fields: WarpFields, order: str) -> Warped:
    """Write an image as the brain is now, with its own header: type, scale, sform and qform stay as they are.

    Label maps have the nearest voxel's label. Voxels whose source lies outside the image, or in tissue that was cut
    away, are 0.
    """
    image, shape = picture.image, picture.volume.values.shape
    proxy, slope, shift = image.dataobj, 1.0, 0.0
    if isinstance(proxy, ArrayProxy):
        proxy, slope, shift = proxy.get_unscaled(), float(proxy.slope), float(proxy.inter)
    stored = np.asanyarray(proxy).reshape(shape)
    values, counts = warped_values(stored, picture.volume.affine, fields, 0 if picture.labels else ORDERS[order])
    blank = 0.0 if shift == 0.0 else -shift / slope
    if blank:
        values[counts.blank] = np.rint(blank) if values.dtype.kind in "iu" else blank
    out = nibabel.Nifti1Image(values.reshape(image.shape), None, image.header)
    if (slope, shift) != (1.0, 0.0):
        out.header.set_slope_inter(slope, shift)
    name = warped_name(picture.path)
    nibabel.save(out, folder / name)
    return Warped(name, counts.moved, counts.outside, counts.gone)


@dataclass(frozen=True, eq=False)
class Counts:
    """How many voxels moved, came from outside the image, or from what was cut away; those that are blank (I, J, K)."""

    moved: int
    outside: int
    gone: int
    blank: np.ndarray


def warped_values(values: np.ndarray, affine: np.ndarray, fields: WarpFields, order: int) -> tuple[np.ndarray, Counts]:
    """Values (I, J, K), whose affine leads to metres (RAS), as the fields move them, of the same type.

    Voxels that do not move keep their value exactly.
    """
    source = values if order == 0 else np.nan_to_num(values.astype(np.float32), posinf=0.0, neginf=0.0)
    if order > 1:
        source = ndimage.spline_filter(source.astype(np.float64), order, mode="nearest")
    out, blank = values.copy(), np.zeros(values.shape, bool)
    moved = outside = gone = 0
    last = np.array(values.shape) - 1
    sides = values.shape[1:]
    for first in range(0, len(values), TOGETHER):
        slab = out[first : first + TOGETHER]
        index = np.stack(np.unravel_index(np.arange(slab.size), slab.shape), axis=-1) + [first, 0, 0]
        now = index @ affine[:3, :3].T + affine[:3, 3]
        went, rows = _moving(fields, now)
        moved += len(rows)
        if not len(rows):
            continue
        then = now[rows] + went
        place = index_of(affine, then)
        off = ((place < -0.5) | (place > last + 0.5)).any(axis=1)
        cut = np.zeros(len(rows), bool)
        if fields.gone.any():
            held = ndimage.map_coordinates(fields.gone, fields.grid.index(then).T, order=0)
            cut = np.asarray(held, bool) & ~off
        read = ndimage.map_coordinates(
            source, np.clip(place, 0, last).T, order=order, mode="nearest", prefilter=False, output=source.dtype
        )
        numbers = np.ravel_multi_index(index[rows].T - np.array([[first], [0], [0]]), (len(slab), *sides))
        slab.reshape(-1)[numbers] = np.where(off | cut, 0, _as(read, values.dtype))
        blank[first : first + TOGETHER].reshape(-1)[numbers] = off | cut
        outside, gone = outside + int(off.sum()), gone + int(cut.sum())
    return out, Counts(moved, outside, gone, blank)


def _moving(fields: WarpFields, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Backward displacements (m, 3) [m] of those rows (m,) of places (n, 3) [m] that have one."""
    index = fields.grid.index(now)
    held = np.flatnonzero(((index > 0.0) & (index < np.array(fields.grid.shape) - 1)).all(axis=1))
    went = fields.grid.read(fields.backward, now[held])
    moves = np.abs(went).max(axis=1) > STILL
    return went[moves], held[moves]


def _as(values: np.ndarray, kind: np.dtype) -> np.ndarray:
    if kind.kind not in "iu":
        return values.astype(kind)
    limits = np.iinfo(kind)
    return np.clip(np.rint(values), limits.min, limits.max).astype(kind)


def _mm(point: np.ndarray) -> str:
    return ", ".join(f"{value:.0f}" for value in point)


def write_field_nifti(path: Path, grid: Grid, field: np.ndarray) -> None:
    """Write a displacement field (3, I, J, K) [m, RAS] as NIfTI: (I, J, K, 1, 3), millimetres, RAS, intent 1006."""
    vectors = np.round(np.moveaxis(1e3 * field, 0, -1)[:, :, :, None], DIGITS).astype(np.float32)
    image = nibabel.Nifti1Image(vectors, np.diag([1e3, 1e3, 1e3, 1.0]) @ grid.affine)
    image.header.set_intent(DISPLACEMENT)
    image.header.set_xyzt_units("mm")
    image.header["descrip"] = b"sulcus: displacement, RAS, mm"
    image.set_sform(image.affine, 1)
    image.set_qform(image.affine, 1)
    nibabel.save(image, path)

"""Deformation of a patient's images and label maps, which are written as NIfTI on their original grids."""

from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np
from nibabel.arrayproxy import ArrayProxy
from scipy import ndimage

from sim.anatomy import Anatomy
from sim.bodies.label_map import has_integers
from sim.bodies.nifti import load_nifti
from sim.bodies.volume import READERS, Volume, read_volume
from sim.bodies.voxels import LPS, VoxelSpec
from sim.errors import InputError
from sim.fields.grid import Grid
from sim.fields.warp_fields import WarpFields

from .nrrd_files import DIGITS

SAMPLING_STRIDE = 3  # Sampling stride along each axis [voxels].


@dataclass(frozen=True)
class ImageWarningSettings:
    """Thresholds of `list_warnings`."""

    min_inside_share: float = 0.98  # Smallest share of the brain inside an image without a warning.
    min_nonzero_share: float = 0.5  # Smallest share of the brain on voxels that are not 0 without a warning.
    bright_percentile: float = 99.0  # Percentile of the positive values that counts as bright [%].
    dark_ratio: float = 0.1  # Threshold of dark voxels (air with noise), relative to the value at `bright_percentile`.
    min_flip_gain: float = 0.05  # Smallest gain of brain on bright voxels when x and y are negated.
    min_flipped_share: float = 0.7  # Smallest share of brain on bright voxels when x and y are negated.
    max_label_values: int = 120  # Largest number of distinct integers of a label map.
    min_equal_neighbours: float = 0.5  # Smallest share of neighbours of one value in a label map: labels fill areas.


IMAGE_WARNINGS = ImageWarningSettings()


SUFFIXES = (".seg.nrrd", *READERS)  # Endings of image files.
ORDERS = {"nearest": 0, "linear": 1, "cubic": 3}
"""Spline degree of each interpolation, by name."""
INTEGER_TYPES = np.uint8, np.int16, np.uint16, np.int32
"""Integer types that every reader of NIfTI supports."""
DISPLACEMENT = 1006
"""NIfTI intent code of a displacement field with vectors in millimetres, RAS."""
MOTION_TOLERANCE = 1e-8  # Displacement below which voxels stay unchanged [m].
BATCH_SLICES = 8  # Number of slices processed together: limits memory.


def measure_brain_coverage(affine: np.ndarray, shape: tuple[int, ...], anatomy: Anatomy) -> float:
    """Return the fraction of the brain's volume inside an image (I, J, K) with an affine (4, 4) to metres (RAS)."""
    _, inside = _find_voxels(affine, shape, _compute_centroids(anatomy))
    return float(np.average(inside, weights=anatomy.mesh.volumes))


def list_warnings(values: np.ndarray, affine: np.ndarray, is_label_map: bool, anatomy: Anatomy) -> list[str]:
    """Return warnings about an image (I, J, K) that shows a part of the brain; each continues the image's name."""
    found, middles, volumes = [], _compute_centroids(anatomy), anatomy.mesh.volumes
    index, inside = _find_voxels(affine, values.shape, middles)
    share = float(np.average(inside, weights=volumes))
    if share < IMAGE_WARNINGS.min_inside_share:
        found.append(f"shows {share:.0%} of the brain; what lies outside is not in it")
    empty = float(np.average(values[tuple(index[inside].T)] == 0, weights=volumes[inside]))
    turned = _detect_flip(values, affine, is_label_map, middles, volumes)
    if turned:
        found.append(
            f"fits the brain in {turned[0]:.0%} of its volume, but in {turned[1]:.0%} with x and y negated: "
            "it may be LPS marked as RAS"
        )
    elif not is_label_map and 1.0 - empty < IMAGE_WARNINGS.min_nonzero_share:
        found.append(
            f"is 0 in {empty:.0%} of the brain's volume: it may be in another space than the labels that the anatomy "
            "was made from"
        )
    if not is_label_map and _is_label_like(values):
        found.append("holds few values, all whole, as label maps do: give one by --labels, or labels are mixed")
    elif is_label_map and (alike := _compute_equal_share(values)) < IMAGE_WARNINGS.min_equal_neighbours:
        found.append(
            f"has the same value in {alike:.0%} of neighbouring voxels, as intensities do: give them by --image, or "
            "values are not interpolated"
        )
    lost = int((~np.isfinite(values)).sum())
    if lost:
        found.append(f"{lost} voxels without a number are taken as 0")
    return found


def _detect_flip(
    values: np.ndarray, affine: np.ndarray, is_label_map: bool, centroids: np.ndarray, volumes: np.ndarray
) -> tuple[float, float] | None:
    """Return the fractions of the brain on bright voxels, as is and with x and y negated; None if x and y are right."""
    part = np.nan_to_num(values[::SAMPLING_STRIDE, ::SAMPLING_STRIDE, ::SAMPLING_STRIDE].astype(float))
    air, bright = 0.0, part[part > 0.0]
    if len(bright) and not is_label_map:
        air = IMAGE_WARNINGS.dark_ratio * float(np.percentile(bright, IMAGE_WARNINGS.bright_percentile))
    shares = []
    for points in (centroids, centroids * LPS):
        index, inside = _find_voxels(affine, values.shape, points)
        shares.append(float(np.average(inside & (values[tuple(index.T)] > air), weights=volumes)))
    as_is, turned = shares
    flips = turned > IMAGE_WARNINGS.min_flipped_share and turned - as_is > IMAGE_WARNINGS.min_flip_gain
    return (as_is, turned) if flips else None


def _is_label_like(values: np.ndarray) -> bool:
    part = values[::SAMPLING_STRIDE, ::SAMPLING_STRIDE, ::SAMPLING_STRIDE]
    return 1 < len(np.unique(part)) <= IMAGE_WARNINGS.max_label_values and np.array_equal(part, np.rint(part))


def _compute_equal_share(values: np.ndarray) -> float:
    """Return the fraction of neighbouring nonzero voxels along the first axis that have equal values."""
    thin = values[:, ::SAMPLING_STRIDE, ::SAMPLING_STRIDE]
    one, two = thin[:-1:SAMPLING_STRIDE], thin[1::SAMPLING_STRIDE]
    full = (one != 0) & (two != 0)
    return float((one == two)[full].mean()) if full.any() else 1.0


def _compute_centroids(anatomy: Anatomy) -> np.ndarray:
    """Return the centroids of the tetrahedra (T, 3) [m]."""
    return anatomy.mesh.nodes[anatomy.mesh.tets].mean(axis=1)


def _find_voxels(affine: np.ndarray, shape: tuple[int, ...], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the voxels (n, 3) nearest to points (n, 3) [m], and a mask (n,): True for points inside the image."""
    index, last = compute_voxel_indices(affine, points), np.array(shape) - 1
    inside = np.asarray(((index >= -0.5) & (index <= last + 0.5)).all(axis=1))
    return np.clip(np.rint(index), 0, last).astype(int), inside


def compute_voxel_indices(affine: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return fractional voxel indices (n, 3) of points (n, 3) [m] in an image with an affine (4, 4)."""
    return (points - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T


@dataclass(frozen=True, eq=False)
class PatientImage:
    """Image of a patient: path, NIfTI image, volume, True in `labels` for a label map, and warnings."""

    path: Path
    image: nibabel.Nifti1Image
    volume: Volume
    labels: bool
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class WarpedImage:
    """File name of a warped image, and its numbers of voxels, see `Counts`."""

    name: str
    moved: int
    outside: int
    resected: int


def read_patient_image(path: Path, anatomy: Anatomy, is_label_map: bool, axes: str = "") -> PatientImage:
    """Read an image or a label map that shows the brain of an anatomy.

    Raises
    ------
    InputError
        See `read_volume`; also if the image does not overlap this brain, or labels are not integers.
    """
    volume = read_volume(path, VoxelSpec(axes=axes), require_finite=False)
    image = _to_nifti(path, volume)
    values = volume.values
    if is_label_map and not has_integers(values):
        raise InputError(f"{path}: holds values that are not whole, so it is no label map. Give it by --image.")
    if measure_brain_coverage(volume.affine, values.shape, anatomy) == 0.0:
        low, high = (1e3 * end for end in (anatomy.mesh.nodes.min(axis=0), anatomy.mesh.nodes.max(axis=0)))
        raise InputError(
            f"{path}: shows none of this brain, which reaches from {_format_millimetres(low)} to "
            f"{_format_millimetres(high)} mm (RAS). Give an image "
            "in the space of the labels that the anatomy was made from, or register it to them first."
        )
    warnings = [*volume.notes, *list_warnings(values, volume.affine, is_label_map, anatomy)]
    return PatientImage(path, image, volume, is_label_map, tuple(warnings))


def _to_nifti(path: Path, volume: Volume) -> nibabel.Nifti1Image:
    """Return the image in a file as NIfTI image.

    Other formats are converted; values and positions stay the same, and integers stay integers.
    """
    if path.name.lower().endswith((".nii", ".nii.gz")):
        return load_nifti(path)
    values = np.nan_to_num(volume.values)
    with np.errstate(invalid="ignore"):
        whole = [kind for kind in INTEGER_TYPES if np.array_equal(values, values.astype(kind))]
    values = values.astype(whole[0] if whole else np.float32)
    made = nibabel.Nifti1Image(values, volume.affine * [[1e3], [1e3], [1e3], [1.0]])
    made.header.set_xyzt_units("mm")
    return made


def to_warped_name(path: Path) -> str:
    """Return the file name of a warped image: the original name with `_deformed`, and the suffix .nii.gz."""
    ending = next((end for end in SUFFIXES if path.name.lower().endswith(end)), "")
    return f"{path.name[: len(path.name) - len(ending)]}_deformed.nii.gz"


def write_warped_image(folder: Path, picture: PatientImage, fields: WarpFields, order: str) -> WarpedImage:
    """Write an image of the deformed brain; type, scale, sform and qform in the header are those of the original.

    Label maps use nearest-neighbour interpolation. Voxels whose source is outside the image, or in resected
    tissue, are 0.
    """
    image, shape = picture.image, picture.volume.values.shape
    proxy, slope, shift = image.dataobj, 1.0, 0.0
    if isinstance(proxy, ArrayProxy):
        proxy, slope, shift = proxy.get_unscaled(), float(proxy.slope), float(proxy.inter)
    stored = np.asanyarray(proxy).reshape(shape)
    values, counts = warp_values(stored, picture.volume.affine, fields, 0 if picture.labels else ORDERS[order])
    blank = 0.0 if shift == 0.0 else -shift / slope
    if blank:
        values[counts.unfilled] = np.rint(blank) if values.dtype.kind in "iu" else blank
    out = nibabel.Nifti1Image(values.reshape(image.shape), None, image.header)
    if (slope, shift) != (1.0, 0.0):
        out.header.set_slope_inter(slope, shift)
    name = to_warped_name(picture.path)
    nibabel.save(out, folder / name)
    return WarpedImage(name, counts.moved, counts.outside, counts.resected)


@dataclass(frozen=True, eq=False)
class Counts:
    """Numbers of voxels that moved, whose source is outside the image, and whose source is in resected tissue.

    `unfilled` (I, J, K) is True for voxels without a source.
    """

    moved: int
    outside: int
    resected: int
    unfilled: np.ndarray


def warp_values(values: np.ndarray, affine: np.ndarray, fields: WarpFields, order: int) -> tuple[np.ndarray, Counts]:
    """Warp values (I, J, K) with an affine (4, 4) to metres (RAS) by the fields; the type stays the same.

    Voxels without displacement keep their exact value. Voxels without a source are 0.
    """
    source = values if order == 0 else np.nan_to_num(values.astype(np.float32), posinf=0.0, neginf=0.0)
    if order > 1:
        source = ndimage.spline_filter(source.astype(np.float64), order, mode="nearest")
    out, blank = values.copy(), np.zeros(values.shape, bool)
    moved = outside = resected = 0
    last = np.array(values.shape) - 1
    sides = values.shape[1:]
    for first in range(0, len(values), BATCH_SLICES):
        slab = out[first : first + BATCH_SLICES]
        index = np.stack(np.unravel_index(np.arange(slab.size), slab.shape), axis=-1) + [first, 0, 0]
        now = index @ affine[:3, :3].T + affine[:3, 3]
        went, rows = _find_moving_points(fields, now)
        moved += len(rows)
        if not len(rows):
            continue
        then = now[rows] + went
        place = compute_voxel_indices(affine, then)
        off = ((place < -0.5) | (place > last + 0.5)).any(axis=1)
        cut = np.zeros(len(rows), bool)
        if fields.resected.any():
            held = ndimage.map_coordinates(fields.resected, fields.grid.to_indices(then).T, order=0)
            cut = np.asarray(held, bool) & ~off
        read = ndimage.map_coordinates(
            source, np.clip(place, 0, last).T, order=order, mode="nearest", prefilter=False, output=source.dtype
        )
        numbers = np.ravel_multi_index(index[rows].T - np.array([[first], [0], [0]]), (len(slab), *sides))
        slab.reshape(-1)[numbers] = np.where(off | cut, 0, _cast_values(read, values.dtype))
        blank[first : first + BATCH_SLICES].reshape(-1)[numbers] = off | cut
        outside, resected = outside + int(off.sum()), resected + int(cut.sum())
    return out, Counts(moved, outside, resected, blank)


def _find_moving_points(fields: WarpFields, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nonzero backward displacements (m, 3) [m] at points (n, 3) [m], and the numbers (m,) of these points."""
    index = fields.grid.to_indices(points)
    held = np.flatnonzero(((index > 0.0) & (index < np.array(fields.grid.shape) - 1)).all(axis=1))
    went = fields.grid.interpolate(fields.backward, points[held])
    moves = np.abs(went).max(axis=1) > MOTION_TOLERANCE
    return went[moves], held[moves]


def _cast_values(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if dtype.kind not in "iu":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


def _format_millimetres(point: np.ndarray) -> str:
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

"""Subject from a label volume: masks of brain and tumour, and the position of the craniotomy."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from scipy import ndimage

from ..anatomy import NECROSIS_LABEL, PART_LABELS
from ..errors import InputError
from ..runtime.outside_files import to_path
from .dural_septa import SEPTA, Septum
from .head_masks import HeadMasks, MaskSources, read_head_masks
from .intensity import read_intensity
from .label_map import Label, Mask, count_border
from .placement import TumourPiece, find_reachable_site
from .signed_distance import Blur, compute_level_set
from .space_consistency import check_scan_space
from .subject import Subject, SubjectPart, find_boundary_voxels
from .voxels import VoxelGrid


@dataclass(frozen=True)
class MaskSettings:
    """Acceptance limits and smoothing of brain and tumour masks.

    Parameters
    ----------
    min_brain_volume, max_brain_volume
        Volume limits [m^3]: they cover all mammals on which neurosurgery is performed, but not wrong labels or units.
    min_tumour_voxels
        Minimum voxels of a tumour component, to resolve its shape.
    min_component_fraction
        Minimum volume of a component, as a fraction of the tumour; smaller ones are noise.
    tumour_extension
        Extension of a tumour beyond the cortex [voxels]; more than the range of `blur`.
    blur
        Smoothing of both masks.
    """

    min_brain_volume: float = 20e-6
    max_brain_volume: float = 5000e-6
    min_tumour_voxels: int = 27
    min_component_fraction: float = 1e-3
    tumour_extension: int = 8
    blur: Blur = field(default_factory=Blur)


def build_volume_subject(
    path: str | Path,
    brain: Sequence[Label],
    tumour: Sequence[Label],
    t1: str | Path | None = None,
    settings: MaskSettings = MaskSettings(),
) -> Subject:
    """Return the subject in an integer label file, given its `brain` and `tumour` labels.

    Raises
    ------
    InputError
        Input that `read_head_masks` or `build_masked_subject` rejects.
    """
    return build_masked_subject(read_head_masks(MaskSources(to_path(path), tuple(brain), tuple(tumour))), t1, settings)


def build_masked_subject(
    masks: HeadMasks, t1: str | Path | None = None, settings: MaskSettings = MaskSettings(), regions: Sequence[str] = ()
) -> Subject:
    """Return the subject whose brain and tumour are voxel masks.

    The solid is the largest component of brain and tumour, with holes filled; tumour components outside it are dropped,
    and each such change is noted. The craniotomy is above the largest of them. `t1` is an intensity volume in the
    same space. Parts of brain and tumour named in `regions`, of `PART_LABELS`, become separate regions.

    Raises
    ------
    InputError
        A region that is unknown or not marked. A T1 that `read_intensity` rejects, or that is evidently LPS declared as
        RAS. A tumour of which more than half lies outside the brain. By default,
        a brain of less than 20 ml or more than 5,000 ml, and a tumour of fewer than 27 voxels; see `settings`.
    """
    for name in regions:
        if name not in PART_LABELS or name not in masks.parts:
            known = ", ".join(one for one in PART_LABELS if one in masks.parts) or "none"
            own = f", or name its labels by --{name}" if name in PART_LABELS else ""
            raise InputError(f"{masks.name}: marks no {name}, so it is no region. Choose from {known}{own}.")
    intensity = None if t1 is None else read_intensity(t1, masks.voxel_spec)
    if t1 is not None and intensity is not None:
        scan = VoxelGrid(to_path(t1), intensity.values.shape, intensity.affine)
        check_scan_space(Mask(Path(masks.name), masks.brain, masks.affine), scan, masks.grids)
    affine, voxel = masks.affine, abs(float(np.linalg.det(masks.affine[:3, :3])))
    notes = list(masks.notes)
    solid = fill_brain(masks, notes, settings)
    inside = _extract_tumour(masks.name, solid, masks.tumour, voxel, notes, settings)
    cortex, interface = find_boundary_voxels(solid, affine), find_boundary_voxels(inside, affine)
    pieces = _list_pieces(inside, affine)
    return Subject(
        brain=compute_level_set(solid, affine, settings.blur),
        tumour=compute_level_set(_extend_tumour(inside, solid, settings.tumour_extension), affine, settings.blur),
        cortex=cortex,
        interface=interface,
        tumour_volume=float(inside.sum() * voxel),
        site=find_reachable_site(cortex, pieces[0].centre),
        intensity=intensity,
        notes=tuple(notes),
        pieces=pieces,
        parts=_build_parts(masks, solid, inside, regions, settings),
        septa=tuple(_build_septum(name, masks) for name in SEPTA if name in masks.parts),
    )


def _build_septum(name: str, masks: HeadMasks) -> Septum:
    """Return the dural sheet that voxels mark."""
    edges = masks.affine[:3, :3]
    points = np.argwhere(masks.parts[name]) @ edges.T + masks.affine[:3, 3]
    return Septum(name, points, 0.5 * float(np.sqrt((edges**2).sum())))


def _build_parts(
    masks: HeadMasks, solid: np.ndarray, tumour: np.ndarray, regions: Sequence[str], settings: MaskSettings
) -> tuple[SubjectPart, ...]:
    """Return the parts that become regions; each volume counts only voxels that the mesh will assign to it."""
    voxel, parts = abs(float(np.linalg.det(masks.affine[:3, :3]))), []
    taken = np.zeros_like(solid)
    for name in reversed(regions):  # if two regions overlap, the later one has priority
        mask, label = masks.parts[name], PART_LABELS[name]
        own = mask & (tumour if label == NECROSIS_LABEL else solid & ~tumour) & ~taken
        taken |= own
        parts.append(SubjectPart(label, compute_level_set(mask, masks.affine, settings.blur), float(own.sum() * voxel)))
    return tuple(reversed(parts))


def fill_brain(masks: HeadMasks, notes: list[str], settings: MaskSettings = MaskSettings()) -> np.ndarray:
    """Return the mask (I, J, K) of a head's brain and tumour as one component without holes; changes are noted.

    Raises
    ------
    InputError
        A brain volume outside the limits of `settings`.
    """
    voxel = abs(float(np.linalg.det(masks.affine[:3, :3])))
    solid = _extract_brain(masks.brain, masks.tumour, voxel, notes)
    smallest, largest = settings.min_brain_volume, settings.max_brain_volume
    if not smallest <= solid.sum() * voxel <= largest:
        raise InputError(
            f"{masks.name}: {masks.brain_source} make a brain of {solid.sum() * voxel * 1e6:.3g} ml; expected "
            f"{smallest * 1e6:g} to {largest * 1e6:g} ml. Check the labels and the voxel size."
        )
    edge = max(count_border(solid), masks.border_voxels)
    if edge:
        notes.append(
            f"{edge} voxels of the brain lie on the volume's border: where it is cut there is no cortex, so see that "
            "the craniotomy lies elsewhere"
        )
    return solid


def _extract_brain(brain: np.ndarray, tumour: np.ndarray, voxel: float, notes: list[str]) -> np.ndarray:
    """Return the component of brain or tumour with most of the brain, its holes filled."""
    component, _ = cast(tuple[np.ndarray, int], ndimage.label(brain | tumour))
    solid = component == np.bincount(component[brain]).argmax()
    lost = int((brain & ~solid).sum())
    if lost:
        notes.append(f"left out {lost * voxel * 1e6:.2g} ml of brain that is not connected to the rest")
    filled = cast(np.ndarray, ndimage.binary_fill_holes(solid))
    holes = int((filled & ~solid).sum())
    if holes:
        notes.append(f"filled {holes * voxel * 1e6:.2g} ml of holes in the brain")
    return filled


def _extract_tumour(
    name: str, solid: np.ndarray, tumour: np.ndarray, voxel: float, notes: list[str], settings: MaskSettings
) -> np.ndarray:
    """Return the tumour's components in the solid, without specks."""
    inside = tumour & solid
    if not inside.any():
        raise InputError(f"{name}: the tumour lies outside the brain. Check the labels given as brain and as tumour.")
    outside = tumour & ~solid
    if 2 * outside.sum() > tumour.sum():
        raise InputError(
            f"{name}: {outside.sum() * voxel * 1e6:.3g} of {tumour.sum() * voxel * 1e6:.3g} ml of the tumour lie "
            "outside the brain, without touching it. Say what is round it, such as oedema or necrosis: --brain takes "
            "several labels."
        )
    component, count = cast(tuple[np.ndarray, int], ndimage.label(inside, np.ones((3, 3, 3))))
    size, fewest = np.bincount(component.ravel(), minlength=count + 1), settings.min_tumour_voxels
    kept = size >= max(settings.min_component_fraction * inside.sum(), fewest)
    kept[0] = False
    if not kept.any():
        raise InputError(
            f"{name}: the tumour's largest component has {size[1:].max()} voxels, and {fewest} are needed to "
            "show its shape. Resample the volume more finely, or check the labels."
        )
    result = kept[component]
    for lost, where in ((outside, "outside the brain"), (inside & ~result, "in specks")):
        if lost.any():
            notes.append(f"left out {lost.sum() * voxel * 1e6:.2g} ml of tumour {where}")
    return result


def _extend_tumour(tumour: np.ndarray, solid: np.ndarray, by: int) -> np.ndarray:
    """Return the tumour extended outside the brain by up to `by` voxels whose nearest brain voxel is tumour.

    The field of a tumour at the cortex then crosses the cortex instead of touching it.
    """
    (box,) = cast(list[tuple[slice, ...]], ndimage.find_objects(tumour.astype(np.uint8)))
    wide = tuple(slice(max(part.start - by, 0), part.stop + by) for part in box)
    if solid[wide].all():
        return tumour
    nearest = ndimage.distance_transform_edt(~solid[wide], return_distances=False, return_indices=True)
    extended = tumour.copy()
    extended[wide] = tumour[wide][tuple(cast(np.ndarray, nearest))]
    return extended


def _list_pieces(tumour: np.ndarray, affine: np.ndarray) -> tuple[TumourPiece, ...]:
    """Return the tumour's connected components, the largest first; the centre is the mean of the surface voxels."""
    component, count = cast(tuple[np.ndarray, int], ndimage.label(tumour, np.ones((3, 3, 3))))
    voxel, pieces = abs(float(np.linalg.det(affine[:3, :3]))), []
    for number in range(1, count + 1):
        one = component == number
        surface = find_boundary_voxels(one, affine)
        pieces.append(TumourPiece(float(one.sum() * voxel), surface.mean(axis=0), surface))
    return tuple(sorted(pieces, key=lambda piece: -piece.volume))

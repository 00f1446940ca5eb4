"""Subject built from a label volume: masks of brain and tumour, and position of the craniotomy."""

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
        Limits of the brain volume [m^3]: brains of all operated mammals pass, but wrong labels or units do not.
    min_tumour_voxels
        Minimum number of voxels of a tumour component, so that its shape is resolved.
    min_component_fraction
        Minimum volume of a component, as a fraction of the tumour volume; smaller components are noise.
    tumour_extension
        Distance [voxels] by which a tumour at the cortex is extended outwards; more than the range of `blur`.
    blur
        Smoothing of the masks of brain and tumour.
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
    """Return the subject in an integer label file, given the labels of brain and tumour.

    Raises
    ------
    InputError
        `read_head_masks` or `build_masked_subject` rejects the input.
    """
    return build_masked_subject(read_head_masks(MaskSources(to_path(path), tuple(brain), tuple(tumour))), t1, settings)


def build_masked_subject(
    masks: HeadMasks, t1: str | Path | None = None, settings: MaskSettings = MaskSettings(), regions: Sequence[str] = ()
) -> Subject:
    """Return the subject whose brain and tumour are voxel masks.

    The solid is the largest component of brain and tumour, with filled holes. Tumour components outside the solid are
    dropped. Notes report each change. The craniotomy is above the largest tumour component. `t1` is an intensity volume
    in the same space. Parts of brain and tumour in `regions`, names in `PART_LABELS`, become separate regions.

    Raises
    ------
    InputError
        A region is unknown or not marked. `read_intensity` rejects the T1, or its LPS coordinates are declared as RAS.
        More than half of the tumour is outside the brain. The brain volume or the number of tumour voxels is outside
        the limits in `settings`: by default, 20 to 5,000 ml and at least 27 voxels.
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
    pieces = _list_components(inside, affine)
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
    """Return the dural sheet `name` from its marked voxels."""
    edges = masks.affine[:3, :3]
    points = np.argwhere(masks.parts[name]) @ edges.T + masks.affine[:3, 3]
    return Septum(name, points, 0.5 * float(np.sqrt((edges**2).sum())))


def _build_parts(
    masks: HeadMasks, solid: np.ndarray, tumour: np.ndarray, regions: Sequence[str], settings: MaskSettings
) -> tuple[SubjectPart, ...]:
    """Return the parts that become regions; the volume of a part includes only voxels that are not in a later part."""
    voxel, parts = abs(float(np.linalg.det(masks.affine[:3, :3]))), []
    taken = np.zeros_like(solid)
    for name in reversed(regions):  # if two regions overlap, the later one has priority
        mask, label = masks.parts[name], PART_LABELS[name]
        own = mask & (tumour if label == NECROSIS_LABEL else solid & ~tumour) & ~taken
        taken |= own
        parts.append(SubjectPart(label, compute_level_set(mask, masks.affine, settings.blur), float(own.sum() * voxel)))
    return tuple(reversed(parts))


def fill_brain(masks: HeadMasks, notes: list[str], settings: MaskSettings = MaskSettings()) -> np.ndarray:
    """Return the mask (I, J, K) of brain and tumour as one component without holes; append changes to `notes`.

    Raises
    ------
    InputError
        The brain volume is outside the limits in `settings`.
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


def _extract_brain(brain: np.ndarray, tumour: np.ndarray, voxel_volume: float, notes: list[str]) -> np.ndarray:
    """Return the component of the union of brain and tumour that contains most of the brain, with filled holes."""
    component, _ = cast(tuple[np.ndarray, int], ndimage.label(brain | tumour))
    solid = component == np.bincount(component[brain]).argmax()
    lost = int((brain & ~solid).sum())
    if lost:
        notes.append(f"left out {lost * voxel_volume * 1e6:.2g} ml of brain that is not connected to the rest")
    filled = cast(np.ndarray, ndimage.binary_fill_holes(solid))
    holes = int((filled & ~solid).sum())
    if holes:
        notes.append(f"filled {holes * voxel_volume * 1e6:.2g} ml of holes in the brain")
    return filled


def _extract_tumour(
    name: str, solid: np.ndarray, tumour: np.ndarray, voxel_volume: float, notes: list[str], settings: MaskSettings
) -> np.ndarray:
    """Return the mask of the tumour components in the solid, without components that are too small."""
    inside = tumour & solid
    if not inside.any():
        raise InputError(f"{name}: the tumour lies outside the brain. Check the labels given as brain and as tumour.")
    outside = tumour & ~solid
    if 2 * outside.sum() > tumour.sum():
        raise InputError(
            f"{name}: {outside.sum() * voxel_volume * 1e6:.3g} of {tumour.sum() * voxel_volume * 1e6:.3g} ml of the "
            "tumour lie outside the brain, without touching it. Say what is round it, such as oedema or necrosis: "
            "--brain takes several labels."
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
            notes.append(f"left out {lost.sum() * voxel_volume * 1e6:.2g} ml of tumour {where}")
    return result


def _extend_tumour(tumour: np.ndarray, solid: np.ndarray, max_voxels: int) -> np.ndarray:
    """Return the tumour with the voxels, at most `max_voxels` outside the brain, whose nearest brain voxel is tumour.

    The tumour's level set then crosses the cortex instead of touching the cortex.
    """
    (box,) = cast(list[tuple[slice, ...]], ndimage.find_objects(tumour.astype(np.uint8)))
    wide = tuple(slice(max(part.start - max_voxels, 0), part.stop + max_voxels) for part in box)
    if solid[wide].all():
        return tumour
    nearest = ndimage.distance_transform_edt(~solid[wide], return_distances=False, return_indices=True)
    extended = tumour.copy()
    extended[wide] = tumour[wide][tuple(cast(np.ndarray, nearest))]
    return extended


def _list_components(tumour: np.ndarray, affine: np.ndarray) -> tuple[TumourPiece, ...]:
    """Return the connected components of the tumour, largest first; the centre is the mean of the boundary voxels."""
    component, count = cast(tuple[np.ndarray, int], ndimage.label(tumour, np.ones((3, 3, 3))))
    voxel, pieces = abs(float(np.linalg.det(affine[:3, :3]))), []
    for number in range(1, count + 1):
        one = component == number
        surface = find_boundary_voxels(one, affine)
        pieces.append(TumourPiece(float(one.sum() * voxel), surface.mean(axis=0), surface))
    return tuple(sorted(pieces, key=lambda piece: -piece.volume))

"""Masks of brain and tumour from one label map or from several files on different grids."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from ..errors import InputError
from .conventions import CONVENTIONS, Convention, check_labels_fit
from .label_contacts import build_contradiction_check, count_label_contacts, find_contradiction
from .label_map import Label, LabelMap, Mask, count_border, format_labels, read_labels, widen_grid
from .placement import describe_side
from .space_consistency import is_mirroring_ambiguous
from .volume import read_volume
from .voxels import DEFAULT_VOXELS, VoxelGrid, VoxelSpec

# Fraction of labelled voxels that may lie outside the mask without a note.
MAX_OUTSIDE_FRACTION = 0.01
NECROSIS = "necrosis"
"""Name of the only part that belongs to the tumour; all other parts belong to the brain."""
# Margin kept around brain and tumour [voxels]: larger than the tumour extension beyond the cortex.
CROP_MARGIN = 10


@dataclass(frozen=True)
class MaskSources:
    """Files and labels that define brain and tumour.

    Parameters
    ----------
    labels
        Label map; its voxel grid is used for all masks.
    brain, tumour
        Labels by number or name; () to use the labels of the convention, or if another file marks the tissue.
    convention
        Name in `CONVENTIONS`, or None.
    mask
        Volume whose nonzero voxels are the brain; used instead of `brain`.
    tumour_file
        Label map to which the labels of `tumour` and necrosis refer; if `tumour` is empty, all labels are tumour.
    parts
        Labels of other tissues, by name in `PART_LABELS` or `SEPTA`; these labels replace those of the convention.
        Necrosis is part of the tumour; all other tissues are part of the brain.
    axes
        Axis directions, such as RAS, for NIfTI files without orientation.
    """

    labels: Path
    brain: tuple[Label, ...] = ()
    tumour: tuple[Label, ...] = ()
    convention: str | None = None
    mask: Path | None = None
    tumour_file: Path | None = None
    parts: Mapping[str, tuple[Label, ...]] = field(default_factory=dict)
    axes: str = ""

    @property
    def voxel_spec(self) -> VoxelSpec:
        """Options for reading the files."""
        return VoxelSpec(axes=self.axes)


@dataclass(frozen=True, eq=False)
class HeadMasks:
    """Masks (I, J, K) bool of brain, tumour and other tissues on a common grid.

    Parameters
    ----------
    name
        File name or names, for error messages.
    brain_source
        Description of the source of the brain mask.
    brain, tumour
        Masks of brain and tumour; the brain mask need not include the tumour.
    border_voxels
        Number of brain voxels on the border of the grid of their file.
    grids
        Voxel grids of the files.
    voxel_spec
        Options for reading further scans of the head.
    parts
        Masks of other tissues by name, from `MaskSources.parts` or the convention.
    affine
        Affine (4, 4) from voxel indices to metres (RAS).
    notes
        Notes for the user on assumptions made while reading.
    """

    name: str
    brain_source: str
    brain: np.ndarray
    tumour: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()
    border_voxels: int = 0
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    grids: tuple[VoxelGrid, ...] = ()
    voxel_spec: VoxelSpec = DEFAULT_VOXELS


def read_head_masks(sources: MaskSources) -> HeadMasks:
    """Read brain and tumour masks on the label map's grid, extended to contain the other files.

    Raises
    ------
    InputError
        `read_labels` or `read_volume` rejects a file, the convention is unknown, or labels do not follow it. Labels are
        missing or given twice, or nothing marks the brain or the tumour. Labels of the left hemisphere are on the right
        side. The tumour in another file is outside the brain.
    """
    convention = _get_convention(sources)
    _check_sources(sources, convention)
    whole = read_labels(sources.labels, sources.voxel_spec)
    brain, tumour = _select_labels(whole, sources, convention)
    marked = {} if sources.mask else {"brain": whole.mask(brain)}
    marked |= {} if sources.tumour_file else {"tumour": whole.mask(tumour)}
    parts = {} if convention is None else _build_part_masks(whole, convention)
    named = {name: labels for name, labels in sources.parts.items() if name != NECROSIS or not sources.tumour_file}
    parts |= {name: whole.mask(labels) for name, labels in named.items()}
    for name in named:
        if (around := _get_enclosing_mask(name)) in marked:
            marked[around] = marked[around] | parts[name]
    marked |= parts
    others, either = _read_other_masks(sources, tumour), False
    if others:
        ours = {name: Mask(Path(sources.labels), mask, whole.affine) for name, mask in marked.items()}
        either = is_mirroring_ambiguous((ours | others)["brain"], (ours | others)["tumour"])
    shape, affine = whole.layers.shape[:3], whole.affine
    for other in others.values():
        lacking, affine = widen_grid(shape, affine, other)
        marked = {name: np.pad(mask, lacking) for name, mask in marked.items()}
        shape = tuple((np.array(shape) + lacking.sum(axis=1)).tolist())
    marked |= {name: other.resample(shape, affine) for name, other in others.items()}
    notes = whole.notes + tuple(f"{one.path}: {note}" for one in others.values() for note in one.notes)
    if convention is None and not sources.mask and not sources.tumour_file:
        notes += _note_unassigned_labels(
            whole, (*brain, *tumour, *(label for labels in named.values() for label in labels))
        )
    if not sources.tumour_file:
        notes += _note_contradictions(whole, tumour, sources.parts)
    if sources.mask:
        notes += _note_voxels_outside(marked, affine) + _note_cavity(whole, convention, named)
    if either:
        notes += (_note_tumour_side(marked, affine, next(iter(others.values())).path),)
    marked, affine = _crop_masks(marked, affine)
    return HeadMasks(
        name=" and ".join(str(path) for path in (sources.labels, sources.mask, sources.tumour_file) if path),
        brain_source=f"the mask {sources.mask}" if sources.mask else f"the labels {format_labels(brain)}",
        brain=marked.pop("brain"),
        tumour=marked.pop("tumour"),
        affine=affine,
        notes=notes,
        border_voxels=count_border(others["brain"].voxels if sources.mask else whole.mask(brain)),
        parts=marked,
        grids=(
            VoxelGrid(Path(sources.labels), whole.layers.shape[:3], whole.affine),
            *(one.grid for name, one in others.items() if name != NECROSIS),
        ),
        voxel_spec=sources.voxel_spec,
    )


def _note_unassigned_labels(label_map: LabelMap, assigned_labels: Sequence[Label]) -> tuple[str, ...]:
    """Return a note, or (), on the labels of the file to which no tissue is assigned."""
    names = {(one.layer, one.value): one.name for one in label_map.segments}
    found = {(layer, value) for layer, present in enumerate(label_map.labels_by_layer) for value in present}
    left = [names.get(place, place[1]) for place in sorted(found - set(label_map.find_layers(assigned_labels)))]
    return (f"neither brain nor tumour: what is labelled {format_labels(left)}",) if left else ()


def _note_contradictions(
    label_map: LabelMap, tumour: Sequence[Label], parts: Mapping[str, tuple[Label, ...]]
) -> tuple[str, ...]:
    """Return a note if the anatomy contradicts the labels given by the user, else ()."""
    if label_map.layers.shape[-1] > 1 or not {NECROSIS, "oedema"}.intersection(parts):
        return ()
    own = {name: tuple(value for _, value in label_map.find_layers(labels)) for name, labels in parts.items()}
    core, necrosis = tuple(value for _, value in label_map.find_layers(tumour)), own.get(NECROSIS, ())
    meant = Convention("own", "", tumour=core + necrosis, necrosis=necrosis, oedema=own.get("oedema", ()))
    found = find_contradiction(count_label_contacts(label_map), meant)
    return (f"{found.reason}: see that the labels mean this",) if found else ()


def _note_tumour_side(masks: dict[str, np.ndarray], affine: np.ndarray, path: Path) -> str:
    """Return a note on the side of the tumour, for a file that would also fit with x and y negated."""
    low, high = Mask(path, masks["brain"], affine).box
    centre = affine[:3, :3] @ np.argwhere(masks["tumour"]).mean(axis=0) + affine[:3, 3]
    return (
        f"{path}: has a grid of its own, and would fit with x and y negated, too. See that it is right that the tumour "
        f"lies {describe_side(centre, low, high)}"
    )


def _note_voxels_outside(masks: dict[str, np.ndarray], affine: np.ndarray) -> tuple[str, ...]:
    """Return a note if a large fraction of the labelled voxels is outside the brain mask, else ()."""
    labelled = np.logical_or.reduce([mask for name, mask in masks.items() if name != "brain"])
    out = int((labelled & ~masks["brain"]).sum())
    if out <= MAX_OUTSIDE_FRACTION * labelled.sum():
        return ()
    lost = 1e6 * out * abs(float(np.linalg.det(affine[:3, :3])))
    return (f"{lost:.2g} ml of what is labelled lie outside of the mask: see that both files are of one space",)


def _note_cavity(
    label_map: LabelMap, convention: Convention | None, assigned_labels: Mapping[str, Sequence[Label]]
) -> tuple[str, ...]:
    """Return a note if the convention marks a fluid-filled cavity, which the brain mask may include; else ()."""
    fluid = _select_existing(convention.csf, label_map) if convention and convention.tumour else ()
    if not fluid or set(fluid) <= {label for labels in assigned_labels.values() for label in labels}:
        return ()
    ml = 1e6 * int(label_map.mask(fluid).sum()) * abs(float(np.linalg.det(label_map.affine[:3, :3])))
    return (
        f"{ml:.2g} ml are a cavity, label {format_labels(fluid)}: where the mask holds it, it becomes brain. "
        f"For a region with a stiffness of its own add --ventricles {','.join(map(str, fluid))}",
    )


def _crop_masks(masks: dict[str, np.ndarray], affine: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the masks cropped to brain and tumour with a margin of `CROP_MARGIN` voxels, and their affine (4, 4)."""
    anything = masks["brain"] | masks["tumour"]
    ends = [np.flatnonzero(anything.any(axis=tuple({0, 1, 2} - {axis})))[[0, -1]] for axis in range(3)]
    low = np.maximum(0, np.array(ends)[:, 0] - CROP_MARGIN)
    part = tuple(slice(first, end[1] + 1 + CROP_MARGIN) for first, end in zip(low, ends, strict=True))
    moved = affine.copy()
    moved[:3, 3] += affine[:3, :3] @ low
    return {name: np.ascontiguousarray(mask[part]) for name, mask in masks.items()}, moved


def _select_labels(
    label_map: LabelMap, sources: MaskSources, convention: Convention | None
) -> tuple[tuple[Label, ...], tuple[Label, ...]]:
    """Return the labels of brain and of tumour: the user's, or those of the convention that the file contains."""
    brain, tumour = sources.brain, sources.tumour
    if convention is not None:
        necrosis = sources.parts.get(NECROSIS, ())
        parts = tuple(label for name, labels in sources.parts.items() if name != NECROSIS for label in labels)
        given = brain + parts + (() if sources.tumour_file else tumour + necrosis)
        named = {value for _, value in label_map.find_layers(given)}
        checked = convention.innermost or (convention.tumour and not sources.tumour and not sources.parts)
        doubts = (build_contradiction_check(label_map, convention),) if checked else ()
        check_labels_fit(sources.labels, convention, label_map.labels, named, *doubts)
        _check_hemispheres(label_map, convention)
        if not brain and not sources.mask:
            brain = _select_existing(convention.brain, label_map)
        if not tumour and not sources.tumour_file:
            tumour = _select_existing(convention.tumour, label_map)
    options = {"brain": "--brain" if sources.brain else "--convention", "tumour": "--tumour"}
    own = {"brain": brain, "tumour": tumour, **sources.parts}
    elsewhere = ("tumour", NECROSIS) if sources.tumour_file else ()
    _check_labels_unique(
        label_map, {name: (options.get(name, f"--{name}"), of) for name, of in own.items() if name not in elsewhere}
    )
    return brain, tumour


def _select_existing(labels: Sequence[int], label_map: LabelMap) -> tuple[int, ...]:
    return tuple(label for label in labels if label in label_map.labels)


def _build_part_masks(label_map: LabelMap, convention: Convention) -> dict[str, np.ndarray]:
    """Return the masks of other tissues of the convention that occur in the file, by name."""
    groups = {NECROSIS: convention.necrosis, "oedema": convention.oedema, "ventricles": convention.ventricles}
    return {name: label_map.mask(found) for name, of in groups.items() if (found := _select_existing(of, label_map))}


def _read_other_masks(sources: MaskSources, tumour: Sequence[Label]) -> dict[str, Mask]:
    """Read the masks of brain and tumour that files other than the label map define, by name."""
    others = {}
    if sources.mask:
        volume = read_volume(sources.mask, sources.voxel_spec)
        others["brain"] = Mask(Path(sources.mask), volume.values != 0, volume.affine, volume.notes)
    if sources.tumour_file:
        second, necrosis = read_labels(sources.tumour_file, sources.voxel_spec), sources.parts.get(NECROSIS, ())
        whole = second.mask((*tumour, *necrosis) if tumour else ())
        several = not tumour and len(second.labels) > 1
        said = format_labels(sorted(second.labels))
        all_of = f"its labels {said} are all taken for tumour: name those of the core by --tumour"
        notes = (*second.notes, all_of) if several else second.notes
        others["tumour"] = Mask(Path(sources.tumour_file), whole, second.affine, notes)
        if necrosis:
            others[NECROSIS] = Mask(Path(sources.tumour_file), second.mask(necrosis), second.affine)
    return others


def _get_convention(sources: MaskSources) -> Convention | None:
    if sources.convention is None:
        return None
    if sources.convention not in CONVENTIONS:
        raise InputError(f"no labels are called {sources.convention!r}: choose one of {', '.join(CONVENTIONS)}.")
    return CONVENTIONS[sources.convention]


def _check_sources(sources: MaskSources, convention: Convention | None) -> None:
    """Reject sources that do not define the brain exactly once and the tumour exactly once."""
    if sources.mask and sources.brain:
        raise InputError("--mask and --brain both define the brain: give only one of them.")
    if sources.mask and sources.tumour_file:
        raise InputError(
            "--mask says what is brain and --tumour-in what is tumour: of the labels nothing is left. Give the "
            "tumour's file as labels, and --mask."
        )
    if convention is not None and convention.needs_brain_mask and not (sources.mask or sources.brain):
        raise InputError(
            f"{sources.labels}: labels of {convention.name} do not mark the brain. Give --mask BRAIN.nii.gz; "
            "a skull-stripped image is accepted."
        )
    if not (sources.brain or sources.mask or (convention and convention.brain)):
        raise InputError("name at least one label of the brain: --brain 1,2, or give --mask BRAIN.nii.gz.")
    if not (sources.tumour or sources.tumour_file or (convention and convention.tumour)):
        raise InputError(
            "name at least one label of the tumour: --tumour 3, or give --tumour-in FILE, in which it is marked."
        )


def _check_labels_unique(label_map: LabelMap, assigned_labels: Mapping[str, tuple[str, Sequence[Label]]]) -> None:
    """Reject a label that two options assign; `assigned_labels` maps each tissue to its option and its labels.

    A label of a part of the brain may also be assigned to brain, and a label of necrosis also to tumour.
    """
    for (one, (option, labels)), (two, (other, others)) in combinations(assigned_labels.items(), 2):
        if one == _get_enclosing_mask(two):
            continue
        places = label_map.find_layers(labels)
        both = [label for label, place in zip(others, label_map.find_layers(others), strict=True) if place in places]
        if both:
            raise InputError(
                f"{label_map.path}: label {format_labels(both)} is named by {option} and by {other}: "
                "give it to one of them."
            )


def _get_enclosing_mask(part: str) -> str:
    """Return the name of the mask that contains a part; an empty string for brain and tumour."""
    return "" if part in ("brain", "tumour") else "tumour" if part == NECROSIS else "brain"


def _check_hemispheres(label_map: LabelMap, convention: Convention) -> None:
    """Reject a file with labels of the left hemisphere on the right side, since its orientation is wrong."""
    right = []
    for side in (convention.left, convention.right):
        index = np.argwhere(np.isin(label_map.layers[..., 0], side))
        right.append(float((index @ label_map.affine[0, :3]).mean()) if len(index) else 0.0)
    if right[0] > right[1]:
        raise InputError(
            f"{label_map.path}: its labels of the left half lie {1e3 * (right[0] - right[1]):.0f} mm to the right of "
            "those of the right half. Its affine is mirrored, or it is LPS declared as RAS: export it again."
        )

"""Which voxels are brain and which tumour, from one label map or from several files on grids of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from ..errors import InputError
from .conventions import CONVENTIONS, Convention, check_labels_fit
from .label_contacts import build_contradiction_check, count_label_contacts, find_contradiction
from .label_map import Label, LabelMap, Mask, count_on_border, format_labels, read_labels, widen_grid
from .one_space import has_one_space
from .placement import describe_side
from .volume import read_volume
from .voxels import OF_BRAINS, VoxelGrid, Voxels

# Share of what is labelled that may lie outside of a mask without a word.
OUTSIDE = 0.01
NECROSIS = "necrosis"
"""The part that lies in the tumour; all others lie in the brain."""
# Voxels that are kept round a brain: more than a tumour at the cortex goes on beyond it.
SURROUNDINGS = 10


@dataclass(frozen=True)
class Sources:
    """Files and labels that say what is brain and what tumour.

    Parameters
    ----------
    labels
        The label map, whose grid is kept.
    brain, tumour
        Labels by number or name; () for those of the convention, or for what other files mark.
    convention
        A name of `CONVENTIONS`, or None.
    mask
        A volume whose voxels other than 0 are brain, in place of `brain`.
    tumour_in
        A label map that the labels `tumour` are of, all of them if there are none, and those of necrosis.
    parts
        Labels of other tissues by name of `PART_LABELS` or `SEPTA`, in place of the convention's. Necrosis counts as
        tumour, and all else as brain.
    axes
        Directions of the axes of NIfTI files that state none, such as RAS.
    """

    labels: Path
    brain: tuple[Label, ...] = ()
    tumour: tuple[Label, ...] = ()
    convention: str | None = None
    mask: Path | None = None
    tumour_in: Path | None = None
    parts: Mapping[str, tuple[Label, ...]] = field(default_factory=dict)
    axes: str = ""

    @property
    def voxels(self) -> Voxels:
        """Voxels that the files may have."""
        return Voxels(axes=self.axes)


@dataclass(frozen=True, eq=False)
class HeadMasks:
    """Marked voxels (I, J, K) bool on one grid.

    Parameters
    ----------
    name
        Of the file, or of the files, as errors say it.
    meant
        What is taken for brain, in words.
    brain, tumour
        What is labelled so; the brain need not hold the tumour.
    cut
        Voxels of the brain on the border of a file that has a grid of its own.
    grids
        Of the files that were read.
    voxels
        Voxels that a scan of the head may have.
    parts
        Other tissues by name, as `Sources.parts`, or as a convention tells them.
    affine
        (4, 4) from indices to metres (RAS).
    notes
        Sentences about what had to be assumed.
    """

    name: str
    meant: str
    brain: np.ndarray
    tumour: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()
    cut: int = 0
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    grids: tuple[VoxelGrid, ...] = ()
    voxels: Voxels = OF_BRAINS


def read_head_masks(sources: Sources) -> HeadMasks:
    """Read what is brain and what tumour, on the label map's grid, widened so far that it holds the other files.

    Raises
    ------
    InputError
        What `read_labels` and `read_volume` refuse; a convention that is not known, or that the labels are not of.
        Labels that are not there, or named twice; no labels, and nothing that stands for them. Left that lies on the
        right. A tumour in another file that does not lie at the brain.
    """
    convention = _convention(sources)
    _demand_named(sources, convention)
    whole = read_labels(sources.labels, sources.voxels)
    brain, tumour = _meant(whole, sources, convention)
    marked = {} if sources.mask else {"brain": whole.mask(brain)}
    marked |= {} if sources.tumour_in else {"tumour": whole.mask(tumour)}
    parts = {} if convention is None else _parts(whole, convention)
    named = {name: labels for name, labels in sources.parts.items() if name != NECROSIS or not sources.tumour_in}
    parts |= {name: whole.mask(labels) for name, labels in named.items()}
    for name in named:
        if (around := _around(name)) in marked:
            marked[around] = marked[around] | parts[name]
    marked |= parts
    others = _others(sources, tumour)
    either = False
    if others:
        ours = {name: Mask(Path(sources.labels), mask, whole.affine) for name, mask in marked.items()}
        either = has_one_space((ours | others)["brain"], (ours | others)["tumour"])
    shape, affine = whole.layers.shape[:3], whole.affine
    for other in others.values():
        lacking, affine = widen_grid(shape, affine, other)
        marked = {name: np.pad(mask, lacking) for name, mask in marked.items()}
        shape = tuple((np.array(shape) + lacking.sum(axis=1)).tolist())
    marked |= {name: other.onto(shape, affine) for name, other in others.items()}
    notes = whole.notes + tuple(f"{one.path}: {note}" for one in others.values() for note in one.notes)
    if convention is None and not sources.mask and not sources.tumour_in:
        notes += _unnamed(whole, (*brain, *tumour, *(label for labels in named.values() for label in labels)))
    if not sources.tumour_in:
        notes += _doubtful(whole, tumour, sources.parts)
    if sources.mask:
        notes += _outside(marked, affine) + _cavity(whole, convention, named)
    if either:
        notes += (_side(marked, affine, next(iter(others.values())).path),)
    marked, affine = _cropped(marked, affine)
    return HeadMasks(
        name=" and ".join(str(path) for path in (sources.labels, sources.mask, sources.tumour_in) if path),
        meant=f"the mask {sources.mask}" if sources.mask else f"the labels {format_labels(brain)}",
        brain=marked.pop("brain"),
        tumour=marked.pop("tumour"),
        affine=affine,
        notes=notes,
        cut=count_on_border(others["brain"].marked if sources.mask else whole.mask(brain)),
        parts=marked,
        grids=(
            VoxelGrid(Path(sources.labels), whole.layers.shape[:3], whole.affine),
            *(one.grid for name, one in others.items() if name != NECROSIS),
        ),
        voxels=sources.voxels,
    )


def _unnamed(whole: LabelMap, named: Sequence[Label]) -> tuple[str, ...]:
    """Return a note on labels of the file that were given no meaning."""
    names = {(one.layer, one.value): one.name for one in whole.segments}
    found = {(layer, value) for layer, present in enumerate(whole.present) for value in present}
    left = [names.get(place, place[1]) for place in sorted(found - set(whole.places(named)))]
    return (f"neither brain nor tumour: what is labelled {format_labels(left)}",) if left else ()


def _doubtful(whole: LabelMap, tumour: Sequence[Label], parts: Mapping[str, tuple[Label, ...]]) -> tuple[str, ...]:
    """Return a note on labels of one's own that the anatomy contradicts."""
    if whole.layers.shape[-1] > 1 or not {NECROSIS, "oedema"}.intersection(parts):
        return ()
    own = {name: tuple(value for _, value in whole.places(labels)) for name, labels in parts.items()}
    core, necrosis = tuple(value for _, value in whole.places(tumour)), own.get(NECROSIS, ())
    meant = Convention("own", "", tumour=core + necrosis, necrosis=necrosis, oedema=own.get("oedema", ()))
    found = find_contradiction(count_label_contacts(whole), meant)
    return (f"{found.reason}: see that the labels mean this",) if found else ()


def _side(marked: dict[str, np.ndarray], affine: np.ndarray, path: Path) -> str:
    """Return a note on which side the tumour lies, as nothing else tells whether a file is of the right space."""
    low, high = Mask(path, marked["brain"], affine).box
    centre = affine[:3, :3] @ np.argwhere(marked["tumour"]).mean(axis=0) + affine[:3, 3]
    return (
        f"{path}: has a grid of its own, and would fit with x and y negated, too. See that it is right that the tumour "
        f"lies {describe_side(centre, low, high)}"
    )


def _outside(marked: dict[str, np.ndarray], affine: np.ndarray) -> tuple[str, ...]:
    """Return a note, if much of what is labelled lies outside of the brain's mask."""
    labelled = np.logical_or.reduce([mask for name, mask in marked.items() if name != "brain"])
    out = int((labelled & ~marked["brain"]).sum())
    if out <= OUTSIDE * labelled.sum():
        return ()
    lost = 1e6 * out * abs(float(np.linalg.det(affine[:3, :3])))
    return (f"{lost:.2g} ml of what is labelled lie outside of the mask: see that both files are of one space",)


def _cavity(whole: LabelMap, convention: Convention | None, named: Mapping[str, Sequence[Label]]) -> tuple[str, ...]:
    """Return a note on fluid that a convention of tumours marks, as a mask of the brain holds it."""
    fluid = _there(convention.csf, whole) if convention and convention.tumour else ()
    if not fluid or set(fluid) <= {label for labels in named.values() for label in labels}:
        return ()
    ml = 1e6 * int(whole.mask(fluid).sum()) * abs(float(np.linalg.det(whole.affine[:3, :3])))
    return (
        f"{ml:.2g} ml are a cavity, label {format_labels(fluid)}: where the mask holds it, it becomes brain. "
        "For a region "
        f"with a stiffness of its own add --ventricles {','.join(map(str, fluid))}",
    )


def _cropped(marked: dict[str, np.ndarray], affine: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the masks where brain or tumour are, and `SURROUNDINGS` voxels round them; and the affine (4, 4) there."""
    anything = marked["brain"] | marked["tumour"]
    ends = [np.flatnonzero(anything.any(axis=tuple({0, 1, 2} - {axis})))[[0, -1]] for axis in range(3)]
    low = np.maximum(0, np.array(ends)[:, 0] - SURROUNDINGS)
    part = tuple(slice(first, end[1] + 1 + SURROUNDINGS) for first, end in zip(low, ends, strict=True))
    moved = affine.copy()
    moved[:3, 3] += affine[:3, :3] @ low
    return {name: np.ascontiguousarray(mask[part]) for name, mask in marked.items()}, moved


def _meant(
    whole: LabelMap, sources: Sources, convention: Convention | None
) -> tuple[tuple[Label, ...], tuple[Label, ...]]:
    """Return the labels of brain and tumour: those given, or the convention's that are there."""
    brain, tumour = sources.brain, sources.tumour
    if convention is not None:
        necrosis = sources.parts.get(NECROSIS, ())
        parts = tuple(label for name, labels in sources.parts.items() if name != NECROSIS for label in labels)
        given = brain + parts + (() if sources.tumour_in else tumour + necrosis)
        named = {value for _, value in whole.places(given)}
        checked = convention.deepest or (convention.tumour and not sources.tumour and not sources.parts)
        doubts = (build_contradiction_check(whole, convention),) if checked else ()
        check_labels_fit(sources.labels, convention, whole.labels, named, *doubts)
        _demand_sides(whole, convention)
        if not brain and not sources.mask:
            brain = _there(convention.brain, whole)
        if not tumour and not sources.tumour_in:
            tumour = _there(convention.tumour, whole)
    options = {"brain": "--brain" if sources.brain else "--convention", "tumour": "--tumour"}
    own = {"brain": brain, "tumour": tumour, **sources.parts}
    elsewhere = ("tumour", NECROSIS) if sources.tumour_in else ()
    _demand_one_meaning(
        whole, {name: (options.get(name, f"--{name}"), of) for name, of in own.items() if name not in elsewhere}
    )
    return brain, tumour


def _there(labels: Sequence[int], whole: LabelMap) -> tuple[int, ...]:
    return tuple(label for label in labels if label in whole.labels)


def _parts(whole: LabelMap, convention: Convention) -> dict[str, np.ndarray]:
    """Masks of the other tissues that the file marks."""
    groups = {NECROSIS: convention.necrosis, "oedema": convention.oedema, "ventricles": convention.ventricles}
    return {name: whole.mask(found) for name, of in groups.items() if (found := _there(of, whole))}


def _others(sources: Sources, tumour: Sequence[Label]) -> dict[str, Mask]:
    """What other files mark."""
    others = {}
    if sources.mask:
        volume = read_volume(sources.mask, sources.voxels)
        others["brain"] = Mask(Path(sources.mask), volume.values != 0, volume.affine, volume.notes)
    if sources.tumour_in:
        second, necrosis = read_labels(sources.tumour_in, sources.voxels), sources.parts.get(NECROSIS, ())
        whole = second.mask((*tumour, *necrosis) if tumour else ())
        several = not tumour and len(second.labels) > 1
        said = format_labels(sorted(second.labels))
        all_of = f"its labels {said} are all taken for tumour: name those of the core by --tumour"
        notes = (*second.notes, all_of) if several else second.notes
        others["tumour"] = Mask(Path(sources.tumour_in), whole, second.affine, notes)
        if necrosis:
            others[NECROSIS] = Mask(Path(sources.tumour_in), second.mask(necrosis), second.affine)
    return others


def _convention(sources: Sources) -> Convention | None:
    if sources.convention is None:
        return None
    if sources.convention not in CONVENTIONS:
        raise InputError(f"no labels are called {sources.convention!r}: choose one of {', '.join(CONVENTIONS)}.")
    return CONVENTIONS[sources.convention]


def _demand_named(sources: Sources, convention: Convention | None) -> None:
    """Refuse where nothing says what the brain is, or the tumour, or where two things do."""
    if sources.mask and sources.brain:
        raise InputError("--mask says what is brain, and --brain does: leave one of them out.")
    if sources.mask and sources.tumour_in:
        raise InputError(
            "--mask says what is brain and --tumour-in what is tumour: of the labels nothing is left. Give the "
            "tumour's file as labels, and --mask."
        )
    if convention is not None and convention.mask and not (sources.mask or sources.brain):
        raise InputError(
            f"{sources.labels}: labels of {convention.name} do not mark the brain. Give --mask BRAIN.nii.gz; "
            "an image without its skull will do."
        )
    if not (sources.brain or sources.mask or (convention and convention.brain)):
        raise InputError("name at least one label of the brain: --brain 1,2, or give --mask BRAIN.nii.gz.")
    if not (sources.tumour or sources.tumour_in or (convention and convention.tumour)):
        raise InputError(
            "name at least one label of the tumour: --tumour 3, or give --tumour-in FILE, in which it is marked."
        )


def _demand_one_meaning(whole: LabelMap, named: Mapping[str, tuple[str, Sequence[Label]]]) -> None:
    """Refuse a label that two options name: by name of a tissue the option and its labels.

    Brain may be named again as a part of brain, and tumour as necrosis.
    """
    for (one, (option, labels)), (two, (other, others)) in combinations(named.items(), 2):
        if one == _around(two):
            continue
        places = whole.places(labels)
        both = [label for label, place in zip(others, whole.places(others), strict=True) if place in places]
        if both:
            raise InputError(
                f"{whole.path}: label {format_labels(both)} is named by {option} and by {other}: "
                "give it to one of them."
            )


def _around(part: str) -> str:
    """What a part of a head counts as; empty of brain and tumour themselves."""
    return "" if part in ("brain", "tumour") else "tumour" if part == NECROSIS else "brain"


def _demand_sides(whole: LabelMap, convention: Convention) -> None:
    """Refuse labels whose left half lies on the right: the file's axes are not what it says."""
    right = []
    for side in (convention.left, convention.right):
        index = np.argwhere(np.isin(whole.layers[..., 0], side))
        right.append(float((index @ whole.affine[0, :3]).mean()) if len(index) else 0.0)
    if right[0] > right[1]:
        raise InputError(
            f"{whole.path}: its labels of the left half lie {1e3 * (right[0] - right[1]):.0f} mm to the right of those "
            "of the right half. Its affine is mirrored, or it is LPS that is stated as RAS: export it anew."
        )

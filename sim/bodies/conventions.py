"""Label conventions of common segmentation programs."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from ..errors import InputError


@dataclass(frozen=True)
class Convention:
    """Label numbers of one segmentation program, in groups; a group may be absent from a file.

    Parameters
    ----------
    name
        Name on the command line.
    source
        Description of the programs that write labels of this convention.
    brain
        Labels of all tissue between the meninges and of the ventricles, without free fluid.
    required
        Labels of `brain` that a file must contain.
    tumour
        Labels of the tumour core; () if another file or label numbers given by the user must mark the tumour.
    necrosis, oedema, ventricles
        Labels of necrosis, a part of the tumour core, and of oedema and ventricles, which are parts of the brain.
    left, right
        Labels that occur in one hemisphere only.
    is_exhaustive
        True if a file has no labels other than those of the convention.
    needs_brain_mask
        True if the brain is marked in another file.
    exclusive
        Set of labels that never occur all together in one file.
    innermost
        Labels of inner tissue; its surface must not be more exposed (at label 0) than that of other tissue.
    """

    name: str
    source: str
    brain: tuple[int, ...] = ()
    required: tuple[int, ...] = ()
    tumour: tuple[int, ...] = ()
    necrosis: tuple[int, ...] = ()
    oedema: tuple[int, ...] = ()
    ventricles: tuple[int, ...] = ()
    csf: tuple[int, ...] = ()
    left: tuple[int, ...] = ()
    right: tuple[int, ...] = ()
    is_exhaustive: bool = False
    needs_brain_mask: bool = False
    exclusive: tuple[int, ...] = ()
    innermost: tuple[int, ...] = ()

    @property
    def labels(self) -> frozenset[int]:
        """All label numbers of the convention except `necrosis`, which is part of `tumour`."""
        return frozenset(self.brain + self.tumour + self.oedema + self.ventricles + self.csf)

    def is_compatible(self, file_labels: Collection[int]) -> bool:
        """Return True if a file with these labels can follow the convention."""
        labels = set(file_labels) - {0}
        if (self.tumour and not labels & set(self.tumour)) or (self.exclusive and labels >= set(self.exclusive)):
            return False
        return set(self.required) <= labels and (not self.is_exhaustive or labels <= self.labels)


def _add_right(*left: int) -> tuple[int, ...]:
    """Return labels of the left hemisphere, followed by those of the same structures on the right (FreeSurfer)."""
    return tuple(sorted((*left, *(RIGHT[label] for label in left))))


RIGHT = {
    2: 41, 3: 42, 4: 43, 5: 44, 7: 46, 8: 47, 9: 48, 10: 49, 11: 50, 12: 51, 13: 52, 17: 53, 18: 54, 26: 58, 28: 60,
    30: 62, 31: 63, 78: 79, 81: 82,
}  # fmt: skip
"""FreeSurfer labels of the right hemisphere, by the label of the same structure on the left."""
# Parcels of the cortex and of the white matter below it (aparc+aseg, wmparc), thousands per hemisphere.
PARCELS = tuple(range(1000, 1036)), tuple(range(2000, 2036)), (*range(3000, 3036), 5001), (*range(4000, 4036), 5002)
VENTRICLES = (*_add_right(4, 5), 14, 15, 72)  # FreeSurfer labels; both hemispheres, and midline
DEEP = (16, 77, 80, 85, *range(251, 256))
"""Labels of structures that belong to no side: brainstem, white matter lesions, chiasm and corpus callosum."""

FREESURFER = Convention(
    "freesurfer",
    "FreeSurfer's and FastSurfer's aseg, aparc+aseg and wmparc",
    brain=(
        *_add_right(2, 3, 7, 8, 9, 10, 11, 12, 13, 17, 18, 26, 28, 30, 31, 78, 81),
        *DEEP, *VENTRICLES, *(parcel for side in PARCELS for parcel in side),
    ),
    required=(2, 41),
    ventricles=VENTRICLES,
    csf=(24,),
    left=(2, 3, 7, 8, *PARCELS[0], *PARCELS[2]),
    right=(41, 42, 46, 47, *PARCELS[1], *PARCELS[3]),
)  # fmt: skip
BRATS = Convention(
    "brats",
    "BraTS: 1 necrotic core, 2 oedema, 4 (until 2022) or 3 (since 2023) enhancing tumour",
    tumour=(1, 3, 4),
    necrosis=(1,),
    oedema=(2,),
    is_exhaustive=True,
    needs_brain_mask=True,
    exclusive=(3, 4),
)
TUMOURS = (
    replace(
        BRATS,
        name="nnunet",
        source="nnU-Net's BraTS models, and the Medical Segmentation Decathlon: 1 oedema, 2 necrotic core, 3 enhancing "
        "tumour",
        tumour=(2, 3),
        necrosis=(2,),
        oedema=(1,),
        exclusive=(),
    ),
    replace(
        BRATS,
        name="brats2015",
        source="BraTS until 2016: 1 necrosis, 2 oedema, 3 non-enhancing and 4 enhancing tumour",
        exclusive=(),
    ),
    replace(
        BRATS,
        name="brats-post",
        source="BraTS after treatment, since 2024: 1 non-enhancing core, 2 oedema, 3 enhancing tumour, 4 cavity of a "
        "resection",
        tumour=(1, 3),
        csf=(4,),
        exclusive=(),
    ),
    replace(
        BRATS,
        name="brats-ped",
        source="BraTS of children, since 2024: 1 enhancing tumour, 2 non-enhancing tumour, 3 cyst, 4 oedema",
        tumour=(1, 2, 3),
        necrosis=(),
        oedema=(4,),
        exclusive=(),
    ),
)
FSL = Convention(
    "fsl",
    "FSL FAST with three classes of a T1: 1 fluid, 2 grey, 3 white matter",
    brain=(2, 3),
    required=(2, 3),
    csf=(1,),
    is_exhaustive=True,
    innermost=(3,),
)
CONVENTIONS = {
    one.name: one
    for one in (
        BRATS,
        FREESURFER,
        replace(FREESURFER, name="synthseg", source="SynthSeg, with or without parcels of the cortex"),
        FSL,
        *TUMOURS,
    )
}
"""Conventions by name. FSL FIRST and SynthSeg use the numbers of FreeSurfer."""


def check_labels_fit(
    path: object,
    convention: Convention,
    file_labels: Collection[int],
    user_labels: Collection[int] = (),
    find_reason: Callable[[Convention], str] = lambda _: "",
) -> None:
    """Reject a file whose labels, except the `user_labels`, do not follow a convention.

    `find_reason` returns the reason why a convention does not apply although the numbers match; empty without a reason.

    Raises
    ------
    InputError
        The labels do not fit; the message lists missing, unknown or contradictory labels and the conventions that fit.
    """
    labels = set(file_labels) - {0} - set(user_labels)
    missing = [label for label in convention.required if label not in labels]
    kin = convention.is_compatible(labels) or (user_labels and not missing)
    if kin:
        why = find_reason(convention)
        if not why:
            return
    elif missing:
        why = f"it lacks {_format_labels(missing)}"
    elif convention.is_exhaustive and not labels <= convention.labels:
        why = f"it has {_format_labels(sorted(labels - convention.labels))} in addition"
    elif convention.exclusive and labels >= set(convention.exclusive):
        why = f"it has {' and '.join(map(str, convention.exclusive))} together"
    else:
        why = f"it has none of {_format_labels([label for label in convention.tumour if label not in user_labels])}"
    others: dict[object, str] = {}
    for one in CONVENTIONS.values():
        if kin and bool(one.tumour) != bool(convention.tumour):
            continue
        if one is not convention and one.is_compatible(labels) and not find_reason(one):
            meant = [labels.intersection(of) for of in (one.tumour, one.oedema, one.necrosis)]
            others.setdefault(str(meant) if one.tumour else one.name, one.name)
    looks = f"It looks like {' or '.join(others.values())}" if others else "Name its labels: --brain 1,2 --tumour 3"
    core = ",".join(str(label) for label in convention.tumour if label in file_labels)
    sure = f"; if it is not, name the core: --tumour {core}" if others and core else ""
    raise InputError(f"{path}: is not labelled as {convention.name} ({convention.source}): {why}. {looks}{sure}.")


def _format_labels(labels: list[int]) -> str:
    return ", ".join(map(str, labels[:8])) + (", ..." if len(labels) > 8 else "")

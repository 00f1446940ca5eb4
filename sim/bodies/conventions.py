"""Table of label conventions of common segmentation programs, by convention name."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from ..errors import InputError


@dataclass(frozen=True)
class Convention:
    """Label numbers of one program; a group may be absent from a file.

    Parameters
    ----------
    name
        Name on the command line.
    source
        Description of the programs that write such labels.
    brain
        Labels of all tissue between the meninges and of the ventricles, without free fluid.
    needed
        Labels of `brain` that a file must contain.
    tumour
        Labels of the tumour core; () if another file or the user's own numbers must mark it.
    necrosis, oedema, ventricles
        Labels of parts of the core, of the brain, and of the brain, respectively.
    left, right
        Labels that occur in one hemisphere only.
    only
        True if a file has no other labels than these.
    mask
        True if the brain is marked in another file.
    apart
        Labels of which a file lacks at least one.
    deepest
        Labels of the innermost tissue.
    """

    name: str
    source: str
    brain: tuple[int, ...] = ()
    needed: tuple[int, ...] = ()
    tumour: tuple[int, ...] = ()
    necrosis: tuple[int, ...] = ()
    oedema: tuple[int, ...] = ()
    ventricles: tuple[int, ...] = ()
    csf: tuple[int, ...] = ()
    left: tuple[int, ...] = ()
    right: tuple[int, ...] = ()
    only: bool = False
    mask: bool = False
    apart: tuple[int, ...] = ()
    deepest: tuple[int, ...] = ()

    @property
    def known(self) -> frozenset[int]:
        """All label numbers of the convention except `necrosis`, which is part of `tumour`."""
        return frozenset(self.brain + self.tumour + self.oedema + self.ventricles + self.csf)

    def is_compatible(self, present: Collection[int]) -> bool:
        """Return True if a file with these labels can follow the convention."""
        labels = set(present) - {0}
        if (self.tumour and not labels & set(self.tumour)) or (self.apart and labels >= set(self.apart)):
            return False
        return set(self.needed) <= labels and (not self.only or labels <= self.known)


def _add_right(*left: int) -> tuple[int, ...]:
    """Return left-hemisphere labels together with their right-hemisphere counterparts, by FreeSurfer's colour table."""
    return tuple(sorted((*left, *(RIGHT[label] for label in left))))


RIGHT = {
    2: 41, 3: 42, 4: 43, 5: 44, 7: 46, 8: 47, 9: 48, 10: 49, 11: 50, 12: 51, 13: 52, 17: 53, 18: 54, 26: 58, 28: 60,
    30: 62, 31: 63, 78: 79, 81: 82,
}  # fmt: skip
"""FreeSurfer labels of the left hemisphere, mapped to those of the right."""
# Parcels of the cortex and of the white matter below it (aparc+aseg, wmparc), thousands per hemisphere.
PARCELS = tuple(range(1000, 1036)), tuple(range(2000, 2036)), (*range(3000, 3036), 5001), (*range(4000, 4036), 5002)
VENTRICLES = (*_add_right(4, 5), 14, 15, 72)  # FreeSurfer labels; both hemispheres, and midline
DEEP = (16, 77, 80, 85, *range(251, 256))
"""Labels without a side: brainstem, white matter lesions, chiasm and corpus callosum."""

FREESURFER = Convention(
    "freesurfer",
    "FreeSurfer's and FastSurfer's aseg, aparc+aseg and wmparc",
    brain=(
        *_add_right(2, 3, 7, 8, 9, 10, 11, 12, 13, 17, 18, 26, 28, 30, 31, 78, 81),
        *DEEP, *VENTRICLES, *(parcel for side in PARCELS for parcel in side),
    ),
    needed=(2, 41),
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
    only=True,
    mask=True,
    apart=(3, 4),
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
        apart=(),
    ),
    replace(
        BRATS,
        name="brats2015",
        source="BraTS until 2016: 1 necrosis, 2 oedema, 3 non-enhancing and 4 enhancing tumour",
        apart=(),
    ),
    replace(
        BRATS,
        name="brats-post",
        source="BraTS after treatment, since 2024: 1 non-enhancing core, 2 oedema, 3 enhancing tumour, 4 cavity of a "
        "resection",
        tumour=(1, 3),
        csf=(4,),
        apart=(),
    ),
    replace(
        BRATS,
        name="brats-ped",
        source="BraTS of children, since 2024: 1 enhancing tumour, 2 non-enhancing tumour, 3 cyst, 4 oedema",
        tumour=(1, 2, 3),
        necrosis=(),
        oedema=(4,),
        apart=(),
    ),
)
FSL = Convention(
    "fsl",
    "FSL FAST with three classes of a T1: 1 fluid, 2 grey, 3 white matter",
    brain=(2, 3),
    needed=(2, 3),
    csf=(1,),
    only=True,
    deepest=(3,),
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
    present: Collection[int],
    own: Collection[int] = (),
    against: Callable[[Convention], str] = lambda _: "",
) -> None:
    """Reject a file whose labels `present` do not follow a convention, apart from the user's `own` labels.

    `against` returns the reason why a convention with matching numbers is not that of the file; empty if it may be.

    Raises
    ------
    InputError
        With the labels that are missing, unknown or contradictory, and the conventions that would fit.
    """
    labels = set(present) - {0} - set(own)
    missing = [label for label in convention.needed if label not in labels]
    kin = convention.is_compatible(labels) or (own and not missing)
    if kin:
        why = against(convention)
        if not why:
            return
    elif missing:
        why = f"it lacks {_format_labels(missing)}"
    elif convention.only and not labels <= convention.known:
        why = f"it has {_format_labels(sorted(labels - convention.known))} in addition"
    elif convention.apart and labels >= set(convention.apart):
        why = f"it has {' and '.join(map(str, convention.apart))} together"
    else:
        why = f"it has none of {_format_labels([label for label in convention.tumour if label not in own])}"
    others: dict[object, str] = {}
    for one in CONVENTIONS.values():
        if kin and bool(one.tumour) != bool(convention.tumour):
            continue
        if one is not convention and one.is_compatible(labels) and not against(one):
            meant = [labels.intersection(of) for of in (one.tumour, one.oedema, one.necrosis)]
            others.setdefault(str(meant) if one.tumour else one.name, one.name)
    looks = f"It looks like {' or '.join(others.values())}" if others else "Name its labels: --brain 1,2 --tumour 3"
    core = ",".join(str(label) for label in convention.tumour if label in present)
    sure = f"; if it is not, name the core: --tumour {core}" if others and core else ""
    raise InputError(f"{path}: is not labelled as {convention.name} ({convention.source}): {why}. {looks}{sure}.")


def _format_labels(labels: list[int]) -> str:
    return ", ".join(map(str, labels[:8])) + (", ..." if len(labels) > 8 else "")

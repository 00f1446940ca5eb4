"""What the labels mean that widely used programs write: one table, by the names of these programs."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from ..errors import InputError


@dataclass(frozen=True)
class Convention:
    """Label numbers of one program; those of a group that a file lacks are no loss.

    Parameters
    ----------
    name
        As it is given on the command line.
    source
        Who writes such labels, in words.
    brain
        Everything between the meninges but free fluid: tissue, and the ventricles as its holes.
    needed
        Of these, all must be there.
    tumour
        Its core; () where another file or own numbers must tell.
    necrosis, oedema, ventricles
        Parts of the core, of the brain, and of the brain.
    left, right
        Of each hemisphere, where its labels are its own.
    only
        Whether a file has no other labels than these.
    mask
        Whether the brain lies in another file.
    apart
        Labels that no file has together.
    deepest
        Labels that lie farthest inside.
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
        """Every number that the convention names."""
        return frozenset(self.brain + self.tumour + self.oedema + self.ventricles + self.csf)

    def fits(self, present: Collection[int]) -> bool:
        """Whether a file with these labels may be of the convention."""
        labels = set(present) - {0}
        if (self.tumour and not labels & set(self.tumour)) or (self.apart and labels >= set(self.apart)):
            return False
        return set(self.needed) <= labels and (not self.only or labels <= self.known)


def _both(*left: int) -> tuple[int, ...]:
    """Labels of the left half, each with its fellow of the right one in FreeSurfer's table of colours."""
    return tuple(sorted((*left, *(RIGHT[label] for label in left))))


RIGHT = {
    2: 41, 3: 42, 4: 43, 5: 44, 7: 46, 8: 47, 9: 48, 10: 49, 11: 50, 12: 51, 13: 52, 17: 53, 18: 54, 26: 58, 28: 60,
    30: 62, 31: 63, 78: 79, 81: 82,
}  # fmt: skip
"""FreeSurfer's labels of the left half and their fellows on the right."""
# Parcels of the cortex and of the white matter under it (aparc+aseg, wmparc): thousands by side.
PARCELS = tuple(range(1000, 1036)), tuple(range(2000, 2036)), (*range(3000, 3036), 5001), (*range(4000, 4036), 5002)
VENTRICLES = (*_both(4, 5), 14, 15, 72)
DEEP = (16, 77, 80, 85, *range(251, 256))
"""Brainstem, lesions of the white matter, chiasm and corpus callosum: of no side."""

FREESURFER = Convention(
    "freesurfer",
    "FreeSurfer's and FastSurfer's aseg, aparc+aseg and wmparc",
    brain=(
        *_both(2, 3, 7, 8, 9, 10, 11, 12, 13, 17, 18, 26, 28, 30, 31, 78, 81),
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
"""By their names. FSL FIRST, and SynthSeg, have the numbers of FreeSurfer."""


def check_labels_fit(
    path: object,
    convention: Convention,
    present: Collection[int],
    own: Collection[int] = (),
    against: Callable[[Convention], str] = lambda _: "",
) -> None:
    """Reject a file whose labels `present` are not those of a convention, but for a user's `own` ones.

    `against` says why a convention whose numbers fit is not that of the file; empty: it may be.

    Raises
    ------
    InputError
        Naming what is missing, not known or contradicted, and the conventions that would fit.
    """
    labels = set(present) - {0} - set(own)
    missing = [label for label in convention.needed if label not in labels]
    kin = convention.fits(labels) or (own and not missing)
    if kin:
        why = against(convention)
        if not why:
            return
    elif missing:
        why = f"it lacks {_listed(missing)}"
    elif convention.only and not labels <= convention.known:
        why = f"it has {_listed(sorted(labels - convention.known))} beside"
    elif convention.apart and labels >= set(convention.apart):
        why = f"it has {' and '.join(map(str, convention.apart))} together"
    else:
        why = f"it has none of {_listed([label for label in convention.tumour if label not in own])}"
    others: dict[object, str] = {}
    for one in CONVENTIONS.values():
        if kin and bool(one.tumour) != bool(convention.tumour):
            continue
        if one is not convention and one.fits(labels) and not against(one):
            meant = [labels.intersection(of) for of in (one.tumour, one.oedema, one.necrosis)]
            others.setdefault(str(meant) if one.tumour else one.name, one.name)
    looks = f"It looks like {' or '.join(others.values())}" if others else "Name its labels: --brain 1,2 --tumour 3"
    core = ",".join(str(label) for label in convention.tumour if label in present)
    sure = f"; if it is not, name the core: --tumour {core}" if others and core else ""
    raise InputError(f"{path}: is not labelled as {convention.name} ({convention.source}): {why}. {looks}{sure}.")


def _listed(labels: list[int]) -> str:
    return ", ".join(map(str, labels[:8])) + (", ..." if len(labels) > 8 else "")

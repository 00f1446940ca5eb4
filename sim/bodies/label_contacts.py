"""Contacts between the labels of a volume, and meanings of labels that the anatomy contradicts."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from .conventions import CONVENTIONS, Convention
from .label_map import LabelMap

# Share of all labelled voxels: an oedema below it is noise.
SPECK = 0.02
# Share of an oedema's surface that faces unlabelled tissue: above SURE in every tumour, below HIDDEN in none.
HIDDEN, SURE = 0.2, 0.4
# Difference of two such shares that is no matter of chance.
MARGIN = 0.1
# Share of the surface of enhancing tumour that touches necrosis: above it the necrosis lies outside.
WRAPPED = 0.7


@dataclass(frozen=True, eq=False)
class Contacts:
    """Labels (n,) of a volume, 0 among them, the areas (n, n) [m^2] where they touch, and their voxels (n,)."""

    labels: np.ndarray
    areas: np.ndarray
    voxels: np.ndarray

    def share(self, of: Collection[int], other: Collection[int]) -> float:
        """Share of the surface of labels that touches other labels; 0 where they have no surface."""
        inside, there = np.isin(self.labels, list(of)), np.isin(self.labels, list(other))
        surface = self.areas[inside][:, ~inside].sum()
        return float(self.areas[inside][:, there & ~inside].sum() / surface) if surface else 0.0

    def volume(self, of: Collection[int]) -> float:
        """Voxels of some labels as a share of all that are labelled."""
        return float(self.voxels[np.isin(self.labels, list(of))].sum() / self.voxels[self.labels != 0].sum())


def count_label_contacts(whole: LabelMap) -> Contacts:
    """Contacts of the labels in the first layer; faces on the border of the volume do not count."""
    layer, affine = whole.layers[..., 0], whole.affine[:3, :3]
    (box,) = ndimage.find_objects((layer != 0).astype(np.uint8))
    layer = layer[tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)]
    labels, number = np.unique(layer, return_inverse=True)
    number, count = number.reshape(layer.shape), len(labels)
    areas = np.zeros((count, count))
    for axis in range(3):
        face = np.linalg.norm(np.cross(affine[:, axis - 2], affine[:, axis - 1]))
        one = np.moveaxis(number, axis, 0)
        pairs = np.bincount((one[:-1] * count + one[1:]).ravel(), minlength=count**2).reshape(count, count)
        areas += face * (pairs + pairs.T)
    return Contacts(labels, areas, np.bincount(number.ravel(), minlength=count))


@dataclass(frozen=True)
class Contradiction:
    """Reason why labels cannot mean what a convention says; not `certain` of one that rare tumours show, too."""

    reason: str
    certain: bool = True


def find_contradiction(contacts: Contacts, convention: Convention) -> Contradiction | None:
    """Compare a convention with the anatomy: necrosis lies inside enhancing tumour, oedema and cortex outside.

    Necrosis or oedema may be missing, or reach the surface of the brain. The rim of a tumour may be open.
    """
    there = set(contacts.labels.tolist()) - {0}
    tumour, oedema, necrosis = (
        there.intersection(of) for of in (convention.tumour, convention.oedema, convention.necrosis)
    )
    outside = {0, *there} - tumour - oedema
    for label in there.intersection(convention.deepest):
        least = min((contacts.share({one}, {0}) for one in there.intersection(convention.known) - {label}), default=1.0)
        found = contacts.share({label}, {0})
        if found > least + MARGIN:
            return Contradiction(f"label {label} lies outside of the others, {found:.0%} of its surface at no label")
    if oedema and tumour and contacts.volume(oedema) >= SPECK:
        found = contacts.share(oedema, outside)
        if found < HIDDEN or found < min(SURE, contacts.share(necrosis, outside) - MARGIN):
            return Contradiction(
                f"label {_words(oedema)} would be oedema and lies inside the tumour, {found:.0%} of its surface at "
                "healthy tissue"
            )
    found = contacts.share(tumour - necrosis, necrosis)
    if found > max(WRAPPED, contacts.share(necrosis, tumour)):
        return Contradiction(
            f"label {_words(necrosis)} would be necrosis and lies round the enhancing tumour, of whose surface it "
            f"covers {found:.0%}",
            certain=False,
        )
    return None


def build_contradiction_check(whole: LabelMap, chosen: Convention) -> Callable[[Convention], str]:
    """Return function that says why the anatomy contradicts a convention; empty where it does not.

    What rare tumours show, too, is held against the `chosen` convention only where another one fits.
    """
    if whole.layers.shape[-1] > 1:
        return lambda _: ""
    contacts = count_label_contacts(whole)
    rivals = [one for one in CONVENTIONS.values() if one is not chosen and one.fits(whole.labels)]

    def reason(one: Convention) -> str:
        found = find_contradiction(contacts, one)
        if found is None or not (found.certain or one is not chosen or any(map(shown, rivals))):
            return ""
        return found.reason

    def shown(one: Convention) -> bool:
        return not reason(one) and _has_oedema_outside(contacts, one)

    return reason


def _has_oedema_outside(contacts: Contacts, convention: Convention) -> bool:
    there = set(contacts.labels.tolist())
    outside = there.difference(convention.tumour, convention.oedema)
    return contacts.share(there.intersection(convention.oedema), outside) >= SURE


def _words(labels: Collection[int]) -> str:
    return " and ".join(map(str, sorted(labels)))

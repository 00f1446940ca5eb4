"""Contact areas between the labels of a volume, and detection of label conventions that contradict the anatomy."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from .conventions import CONVENTIONS, Convention
from .label_map import LabelMap


@dataclass(frozen=True)
class ContradictionSettings:
    """Thresholds of `find_contradiction`."""

    # Minimum oedema volume, as a fraction of all labelled voxels; smaller ones are noise.
    min_oedema_fraction: float = 0.02
    # Fraction of an oedema's surface that faces neither tumour nor oedema.
    min_outer_fraction: float = 0.2  # below it in no tumour
    certain_outer_fraction: float = 0.4  # above it in every tumour
    min_difference: float = 0.1  # Significant difference between two such fractions.
    # Fraction of the enhancing tumour's surface at necrosis above which the necrosis lies outside.
    max_wrapped_fraction: float = 0.7


CONTRADICTION = ContradictionSettings()


@dataclass(frozen=True, eq=False)
class LabelContacts:
    """Labels (n,) of a volume including 0, contact areas (n, n) [m^2] between two labels, and voxel counts (n,)."""

    labels: np.ndarray
    areas: np.ndarray
    voxels: np.ndarray

    def measure_contact(self, labels: Collection[int], other_labels: Collection[int]) -> float:
        """Return the fraction of the surface of `labels` that touches `other_labels`; 0 without a surface."""
        inside, there = np.isin(self.labels, list(labels)), np.isin(self.labels, list(other_labels))
        surface = self.areas[inside][:, ~inside].sum()
        return float(self.areas[inside][:, there & ~inside].sum() / surface) if surface else 0.0

    def compute_voxel_fraction(self, labels: Collection[int]) -> float:
        """Return the number of voxels with one of these `labels`, as a fraction of all labelled voxels."""
        return float(self.voxels[np.isin(self.labels, list(labels))].sum() / self.voxels[self.labels != 0].sum())


def count_label_contacts(label_map: LabelMap) -> LabelContacts:
    """Return the contact areas of the labels in the first layer; faces on the border of the volume do not count."""
    layer, affine = label_map.layers[..., 0], label_map.affine[:3, :3]
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
    return LabelContacts(labels, areas, np.bincount(number.ravel(), minlength=count))


@dataclass(frozen=True)
class Contradiction:
    """Reason why labels do not follow a convention; `is_certain` is False if rare tumours also cause this reason."""

    reason: str
    is_certain: bool = True


def find_contradiction(contacts: LabelContacts, convention: Convention) -> Contradiction | None:
    """Return a contradiction between a convention and the anatomy, or None.

    Necrosis must be inside the enhancing tumour; oedema and cortex must be outside. Each of them may be missing.
    """
    there = set(contacts.labels.tolist()) - {0}
    known = convention.tumour, convention.oedema, convention.necrosis
    tumour, oedema, necrosis = map(there.intersection, known)
    outside = {0, *there} - tumour - oedema
    for label in there.intersection(convention.innermost):
        least = min(
            (contacts.measure_contact({one}, {0}) for one in there.intersection(convention.labels) - {label}),
            default=1.0,
        )
        found = contacts.measure_contact({label}, {0})
        if found > least + CONTRADICTION.min_difference:
            return Contradiction(f"label {label} lies outside of the others, {found:.0%} of its surface at no label")
    if oedema and tumour and contacts.compute_voxel_fraction(oedema) >= CONTRADICTION.min_oedema_fraction:
        found = contacts.measure_contact(oedema, outside)
        least = contacts.measure_contact(necrosis, outside) - CONTRADICTION.min_difference
        if found < max(CONTRADICTION.min_outer_fraction, min(CONTRADICTION.certain_outer_fraction, least)):
            return Contradiction(
                f"label {_format_label_set(oedema)} would be oedema and lies inside the tumour, {found:.0%} of its "
                "surface at healthy tissue"
            )
    found = contacts.measure_contact(tumour - necrosis, necrosis)
    if found > max(CONTRADICTION.max_wrapped_fraction, contacts.measure_contact(necrosis, tumour)):
        return Contradiction(
            f"label {_format_label_set(necrosis)} would be necrosis and lies round the enhancing tumour, of whose "
            f"surface it covers {found:.0%}",
            is_certain=False,
        )
    return None


def build_contradiction_check(label_map: LabelMap, convention: Convention) -> Callable[[Convention], str]:
    """Return a function of a convention that gives the reason why the anatomy contradicts it; empty without a reason.

    An uncertain contradiction counts against `convention` only if another convention fits.
    """
    if label_map.layers.shape[-1] > 1:
        return lambda _: ""
    contacts = count_label_contacts(label_map)
    rivals = [one for one in CONVENTIONS.values() if one is not convention and one.is_compatible(label_map.labels)]

    def find_reason(candidate: Convention) -> str:
        found = find_contradiction(contacts, candidate)
        if found is None or not (found.is_certain or candidate is not convention or any(map(is_supported, rivals))):
            return ""
        return found.reason

    def is_supported(candidate: Convention) -> bool:
        return not find_reason(candidate) and _has_oedema_outside(contacts, candidate)

    return find_reason


def _has_oedema_outside(contacts: LabelContacts, convention: Convention) -> bool:
    there = set(contacts.labels.tolist())
    outside = there.difference(convention.tumour, convention.oedema)
    return (
        contacts.measure_contact(there.intersection(convention.oedema), outside) >= CONTRADICTION.certain_outer_fraction
    )


def _format_label_set(labels: Collection[int]) -> str:
    return " and ".join(map(str, sorted(labels)))

"""What a data set's body is made of, as its provenance states it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from sim.anatomy import TUMOUR_LABEL
from sim.effects import Elasticity
from sim.material import tissue_from_json, tissue_to_json

BRAIN = "tissue"
"""The key of the brain's tissue. A region that is made of what the brain is has none of its own."""
TUMOUR, REGION = "tumour's tissue", "tissue of region "
"""The key of the tumour's tissue, and how that of another region's begins, before its label."""


def stating(tissue: Elasticity) -> dict[str, str]:
    """What the provenance of data of this tissue states of it; nothing of a brain without law."""
    stated = {} if tissue.default is None else {BRAIN: tissue_to_json(tissue.default)}
    return stated | {_key(label): tissue_to_json(tissue.regions[label]) for label in sorted(tissue.regions)}


def stated_tissue(stated: Mapping[str, str]) -> Elasticity:
    """What a provenance states, which must state the brain's.

    Raises
    ------
    InputError
        A text that is no tissue.
    """
    numbers = (key.removeprefix(REGION) for key in stated if key.startswith(REGION))
    labels = {TUMOUR_LABEL, *(int(number) for number in numbers if number.lstrip("-").isdecimal())}
    regions = {label: tissue_from_json(stated[_key(label)]) for label in sorted(labels) if _key(label) in stated}
    return Elasticity(tissue_from_json(stated[BRAIN]), regions)


def first_stated(statements: Iterable[Mapping[str, str]]) -> Elasticity | None:
    """`stated_tissue` of the first statement that states the brain's; None where none does."""
    stated = next((one for one in statements if BRAIN in one), None)
    return None if stated is None else stated_tissue(stated)


def _key(label: int) -> str:
    return TUMOUR if label == TUMOUR_LABEL else f"{REGION}{label}"

"""What a data set's body is made of, as its provenance states it."""

from __future__ import annotations

from collections.abc import Mapping

from sim.anatomy import TUMOUR_LABEL
from sim.effects import Elasticity
from sim.material import tissue_from_json, tissue_to_json

BRAIN, TUMOUR = "tissue", "tumour's tissue"
"""The keys of both; a tumour that is made of what the brain is has none."""


def stating(tissue: Elasticity) -> dict[str, str]:
    """What the provenance of data of this tissue states of it; nothing of a brain without law."""
    stated = {} if tissue.default is None else {BRAIN: tissue_to_json(tissue.default)}
    other = tissue.regions.get(TUMOUR_LABEL)
    return stated if other is None else {**stated, TUMOUR: tissue_to_json(other)}


def stated_tissue(stated: Mapping[str, str]) -> Elasticity:
    """What a provenance states, which must state the brain's.

    Raises
    ------
    InputError
        A text that is no tissue.
    """
    tumour = {TUMOUR_LABEL: tissue_from_json(stated[TUMOUR])} if TUMOUR in stated else {}
    return Elasticity(tissue_from_json(stated[BRAIN]), tumour)

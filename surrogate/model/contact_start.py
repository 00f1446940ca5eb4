"""Going on with a rod or a blade from where an answer had it: the search for its contact then begins there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sim.deformation import Deformation
from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS, Encoder
from ..regressors.protocol import Fitted
from ..regressors.rigid_contact import Contact

HELD = "where a blade touches"
"""What is warm in an answer: rows of `Contact.held`."""


def going_on(regressors: Sequence[Fitted], start: Deformation | None) -> Mapping[str, Encoder]:
    """Encoders whose features of rods and blades hold where a start had them, where it says so."""
    contact, held = _contact(regressors), None if start is None else start.warm.get(HELD)
    if contact is None or held is None or held.shape[1:] != (contact.held_width,) or not np.isfinite(held).all():
        return ENCODERS
    core = ENCODERS["core"]

    def followed(patch: Patch, pushed: Pushed) -> np.ndarray:
        return np.hstack([core(patch, pushed), held])

    return {**ENCODERS, "core": followed}


def held_of(
    regressors: Sequence[Fitted], patch: Patch, asked: Pushed, encoders: Mapping[str, Encoder]
) -> dict[str, np.ndarray]:
    """What an answer to indentations keeps warm for the next one: rows (B, h), or nothing."""
    contact = _contact(regressors)
    return {} if contact is None else {HELD: contact.held(encoders["core"](patch, asked))}


def _contact(regressors: Sequence[Fitted]) -> Contact | None:
    """That of a rod or a blade; a ball's search is short."""
    return next((each for each in regressors if isinstance(each, Contact) and len(each.core)), None)

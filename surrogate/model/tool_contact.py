"""Contact of a tool that a model of its poses learned: its force, and the start of the search for contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation
from sim.loads import Pushed
from sim.tools import Ball, BuiltIn

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS, Encoder
from ..regressors.protocol import Fitted
from ..regressors.rigid_contact import Contact
from .conformal import Bound


@dataclass(frozen=True, eq=False)
class ForceModel:
    """What a model of poses has learned of its tool's force.

    Parameters
    ----------
    encoder
        A name in `ENCODERS`: what the regressor is given.
    learned
        From features of an indentation to the force (B, 3) [N/m] by one metre of depth. Of a model with a part of
        contact it is what that leaves; None: nothing is added.
    bound
        Of the force's error [N], if loads were kept apart to calibrate it.
    """

    encoder: str = "tool"
    learned: Fitted | None = None
    bound: Bound | None = None

    def added(self, patch: Patch, asked: Pushed) -> np.ndarray | float:
        """What the regressor says to indentations (B, 3) [N/m]."""
        return 0.0 if self.learned is None else self.learned.predict(ENCODERS[self.encoder](patch, asked))


def wrench(force: np.ndarray, pose: np.ndarray, tool: BuiltIn) -> np.ndarray:
    """Force [N] and moment about the tool's origin [N m] of one tool at poses (B, 4, 4): (B, 1, 6), of forces (B, 3).

    What presses on a ball without friction goes through its middle. The moment of other tools is not known: NaN.
    """
    known = isinstance(tool, Ball)
    moment = np.cross(tool.radius * pose[:, :3, 2], force) if known else np.full(force.shape, np.nan)
    return np.concatenate([force, moment], axis=1)[:, None]


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

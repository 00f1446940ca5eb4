"""Tool contact of a pose model: prediction of the tool's force, and warm starts of the contact search."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation
from sim.loads import Pushed
from sim.tools import Ball, BuiltIn

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS, Encoder
from ..regressors.protocol import FittedRegressor
from ..regressors.rigid_contact import RigidContact
from .conformal import Bound


@dataclass(frozen=True, eq=False)
class ForceModel:
    """Trained model of a tool's force.

    Parameters
    ----------
    encoder
        Name in `ENCODERS` of the function that computes the regressor's features.
    regressor
        Map from features of an indentation to the force (B, 3) [N/m] per metre of depth; in a model with a contact
        part, to the difference from that part's force. None: nothing is added to the contact part.
    bound
        Bound of the force's error [N]; None if no calibration loads were set aside.
    """

    encoder: str = "tool"
    regressor: FittedRegressor | None = None
    bound: Bound | None = None

    def predict_remainder(self, patch: Patch, pushes: Pushed) -> np.ndarray | float:
        """Predict the force (B, 3) [N/m] per metre of depth that the regressor adds; 0 without a regressor."""
        return 0.0 if self.regressor is None else self.regressor.predict(ENCODERS[self.encoder](patch, pushes))


def compute_wrench(force: np.ndarray, pose: np.ndarray, tool: BuiltIn) -> np.ndarray:
    """Compute wrenches (B, 1, 6) from forces (B, 3) [N] at poses (B, 4, 4): force, then moment about the tool's origin.

    The pressure on a ball acts through its centre, as contact has no friction. For other tools the moment [N m] is NaN.
    """
    known = isinstance(tool, Ball)
    moment = np.cross(tool.radius * pose[:, :3, 2], force) if known else np.full(force.shape, np.nan)
    return np.concatenate([force, moment], axis=1)[:, None]


CONTACT_KEY = "where a blade touches"
"""Key of the contact state in `Deformation.warm`: rows of `RigidContact.compute_warm_start`."""


def build_warm_encoders(regressors: Sequence[FittedRegressor], start: Deformation | None) -> Mapping[str, Encoder]:
    """Return encoders that start the contact search from the contact state in `start`; `ENCODERS` if there is none."""
    contact, held = _find_contact(regressors), None if start is None else start.warm.get(CONTACT_KEY)
    if contact is None or held is None or held.shape[1:] != (contact.warm_start_width,) or not np.isfinite(held).all():
        return ENCODERS
    core = ENCODERS["core"]

    def encode_contact(patch: Patch, pushes: Pushed) -> np.ndarray:
        return np.hstack([core(patch, pushes), held])

    return {**ENCODERS, "core": encode_contact}


def collect_contact_state(
    regressors: Sequence[FittedRegressor], patch: Patch, pushes: Pushed, encoders: Mapping[str, Encoder]
) -> dict[str, np.ndarray]:
    """Return the contact state (B, h) for the next warm start, under `CONTACT_KEY`; empty without a rod or a blade."""
    contact = _find_contact(regressors)
    return {} if contact is None else {CONTACT_KEY: contact.compute_warm_start(encoders["core"](patch, pushes))}


def _find_contact(regressors: Sequence[FittedRegressor]) -> RigidContact | None:
    """Return the contact regressor of a rod or a blade, else None; a ball's contact search needs no warm start."""
    return next((each for each in regressors if isinstance(each, RigidContact) and len(each.core)), None)

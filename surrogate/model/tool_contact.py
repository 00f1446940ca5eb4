"""Tool contact of a pose model: model of the tool's force, and warm starts of the contact search."""

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
        Name in `ENCODERS`: features for the regressor.
    regressor
        Map from features of an indentation to the force (B, 3) [N/m] per metre of depth. With a contact part it
        predicts the remainder; None: nothing is added.
    bound
        Bound of the force's error [N], if calibration loads were set aside.
    """

    encoder: str = "tool"
    regressor: FittedRegressor | None = None
    bound: Bound | None = None

    def predict_remainder(self, patch: Patch, pushes: Pushed) -> np.ndarray | float:
        """Predict the regressor's contribution (B, 3) [N/m] at indentations."""
        return 0.0 if self.regressor is None else self.regressor.predict(ENCODERS[self.encoder](patch, pushes))


def compute_wrench(force: np.ndarray, pose: np.ndarray, tool: BuiltIn) -> np.ndarray:
    """Compute force [N] and moment about the tool's origin [N m] at poses (B, 4, 4): (B, 1, 6), from forces (B, 3).

    Frictionless pressure on a ball acts through its centre. The moment of other tools is not available: NaN.
    """
    known = isinstance(tool, Ball)
    moment = np.cross(tool.radius * pose[:, :3, 2], force) if known else np.full(force.shape, np.nan)
    return np.concatenate([force, moment], axis=1)[:, None]


CONTACT_KEY = "where a blade touches"
"""Key of the contact in the warm data of a result: rows of `RigidContact.compute_warm_start`."""


def build_warm_encoders(regressors: Sequence[FittedRegressor], start: Deformation | None) -> Mapping[str, Encoder]:
    """Return encoders that start rods and blades from the contact stored in `start`, if there is one."""
    contact, held = _find_contact(regressors), None if start is None else start.warm.get(CONTACT_KEY)
    if contact is None or held is None or held.shape[1:] != (contact.warm_start_width,) or not np.isfinite(held).all():
        return ENCODERS
    core = ENCODERS["core"]

    def followed(patch: Patch, pushed: Pushed) -> np.ndarray:
        return np.hstack([core(patch, pushed), held])

    return {**ENCODERS, "core": followed}


def collect_contact_state(
    regressors: Sequence[FittedRegressor], patch: Patch, pushes: Pushed, encoders: Mapping[str, Encoder]
) -> dict[str, np.ndarray]:
    """Return the contact to store with a result for the next warm start: rows (B, h), or nothing."""
    contact = _find_contact(regressors)
    return {} if contact is None else {CONTACT_KEY: contact.compute_warm_start(encoders["core"](patch, pushes))}


def _find_contact(regressors: Sequence[FittedRegressor]) -> RigidContact | None:
    """Return the contact regressor of a rod or a blade; a ball's search is short."""
    return next((each for each in regressors if isinstance(each, RigidContact) and len(each.core)), None)

"""The force that a tool moved by pose exerts: learned beside the motion, with a bound of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed
from sim.tools import Ball, BuiltIn

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS
from ..regressors.protocol import Fitted
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

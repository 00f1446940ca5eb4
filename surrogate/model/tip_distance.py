"""The distance from tip to tumour by a trained model: its mean error is corrected, and it has a bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import directions, tool_features
from ..regressors.force_series import with_pressing
from ..regressors.gp import Gp
from .conformal import Bound

# Training loads at most: those that fit the process's lengths, and those that it is conditioned on.
ROWS, MOST = 300, 2000


@dataclass(frozen=True, eq=False)
class Distance:
    """Distances from tip to tumour.

    Parameters
    ----------
    value
        (B,) [m].
    bound
        (2, B) [m]: with probability 0.95, and 0.99, the finite elements' distance is no farther off; NaN where nothing
        is promised.
    """

    value: np.ndarray
    bound: np.ndarray


@dataclass(frozen=True)
class TipModel:
    """The learned correction and bound of the distance itself.

    The tip rests on the predicted cortex, and learners know the cortex less well than the tumour. A Gaussian process
    learns how far the distance between the two predictions is off, for each newton.

    Parameters
    ----------
    correction
        From `tool_features` and force over radius to what must be added [m/N]; None where that did not help.
    bound
        Of the corrected distance, if loads were kept apart to calibrate it.
    """

    correction: Gp | None = None
    bound: Bound | None = None

    def corrected(self, distance: np.ndarray, patch: Patch, asked: Pushed, magnitude: np.ndarray) -> np.ndarray:
        """Distances (B,) [m] corrected for loads `asked` within the training forces, of true magnitude (B,) [N]."""
        if self.correction is None:
            return distance
        off = self.correction.predict(correction_features(patch, asked))[:, 0]
        return np.maximum(distance + magnitude * off, 0.0)


def correction_features(patch: Patch, pushed: Pushed) -> np.ndarray:
    """The features of a correction (B, 9): `tool_features`, and force over radius."""
    return with_pressing(tool_features(patch, pushed))


def fitted_correction(patch: Patch, pushed: Pushed, off: np.ndarray) -> Gp | None:
    """Learn how far distances are `off` (B,) [m] under loads; None where none of them presses."""
    magnitude = directions(pushed)[0]
    some = magnitude > 0.0
    if not some.any():
        return None
    return Gp(rows=ROWS, most=MOST).fit(
        correction_features(patch, pushed)[some], (off[some] / magnitude[some])[:, None]
    )

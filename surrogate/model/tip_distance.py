"""Distance from tip to tumour by a trained model: corrected for its mean error, with a bound."""

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import compute_tool_features, split_forces
from ..regressors.force_series import append_force_ratio
from ..regressors.gp import Gp
from .conformal import Bound

MAX_LENGTH_LOADS = 300  # Maximum number of training loads that fit the Gaussian process's lengths.
MAX_CONDITIONING_LOADS = 2000  # Maximum number of training loads that condition the Gaussian process.


@dataclass(frozen=True, eq=False)
class TumourDistance:
    """Distances from tip to tumour.

    Parameters
    ----------
    distance
        Distances (B,) [m].
    bound
        (2, B) [m]: error bound relative to FEM, with probability 0.95 and 0.99; NaN without a guarantee.
    """

    distance: np.ndarray
    bound: np.ndarray


@dataclass(frozen=True)
class TipModel:
    """Trained correction and bound of the distance itself.

    The tip is on the predicted cortex, where errors are larger than at the tumour. A Gaussian process predicts the
    error of the distance between the two, per newton.

    Parameters
    ----------
    correction
        Map from `compute_tool_features` and force over radius to the correction [m/N]; None if that did not help.
    bound
        Bound of the corrected distance, if calibration loads were set aside.
    """

    correction: Gp | None = None
    bound: Bound | None = None

    def apply_correction(self, distance: np.ndarray, patch: Patch, pushes: Pushed, magnitude: np.ndarray) -> np.ndarray:
        """Correct distances (B,) [m]: loads `pushes` clipped to the training range, unclipped magnitude (B,) [N]."""
        if self.correction is None:
            return distance
        off = self.correction.predict(compute_correction_features(patch, pushes))[:, 0]
        return np.maximum(distance + magnitude * off, 0.0)


def compute_correction_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute the features of a correction (B, 9): `compute_tool_features`, and force over radius."""
    return append_force_ratio(compute_tool_features(patch, pushes))


def fit_correction(patch: Patch, pushes: Pushed, error: np.ndarray) -> Gp | None:
    """Fit the error `error` (B,) [m] of distances under loads; None if no load presses."""
    magnitude = split_forces(pushes)[0]
    some = magnitude > 0.0
    if not some.any():
        return None
    return Gp(likelihood_rows=MAX_LENGTH_LOADS, max_rows=MAX_CONDITIONING_LOADS).fit(
        compute_correction_features(patch, pushes)[some], (error[some] / magnitude[some])[:, None]
    )

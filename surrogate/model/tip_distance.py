"""Distance from the tool's tip to the tumour: a trained correction of the model's mean error, and an error bound."""

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import compute_tool_features, split_forces
from ..regressors.force_series import append_force_ratio
from ..regressors.gp import Gp
from .conformal import Bound

MAX_LENGTH_LOADS = 300  # Maximum number of training loads to which the Gaussian process's length scales are fitted.
MAX_CONDITIONING_LOADS = 2000  # Maximum number of training loads that condition the Gaussian process.


@dataclass(frozen=True, eq=False)
class TumourDistance:
    """Distances from the tool's tip to the tumour, with error bounds.

    Parameters
    ----------
    distance
        Distances (B,) [m].
    bound
        Error bounds (2, B) [m] relative to FEM, with probability 0.95 and 0.99; NaN where nothing is guaranteed.
    """

    distance: np.ndarray
    bound: np.ndarray


@dataclass(frozen=True)
class TipModel:
    """Trained correction of the distance from tip to tumour, with a bound of the corrected distance.

    The tip is on the predicted cortex, where errors are larger than at the tumour. A Gaussian process predicts the
    error of the tip-tumour distance per newton.

    Parameters
    ----------
    correction
        Map from `compute_correction_features` to the correction [m/N]; None if a correction did not reduce the error.
    bound
        Bound of the corrected distance's error; None if no calibration loads were set aside.
    """

    correction: Gp | None = None
    bound: Bound | None = None

    def apply_correction(self, distance: np.ndarray, patch: Patch, pushes: Pushed, magnitude: np.ndarray) -> np.ndarray:
        """Correct distances (B,) [m]; `pushes` are clipped to the training range, `magnitude` (B,) [N] is not."""
        if self.correction is None:
            return distance
        off = self.correction.predict(compute_correction_features(patch, pushes))[:, 0]
        return np.maximum(distance + magnitude * off, 0.0)


def compute_correction_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute the input features (B, 9) of a correction: `compute_tool_features`, then the ratio of force to radius."""
    return append_force_ratio(compute_tool_features(patch, pushes))


def fit_correction(patch: Patch, pushes: Pushed, error: np.ndarray) -> Gp | None:
    """Fit a correction to the distance error `error` (B,) [m] under the loads; None if all forces are zero."""
    magnitude = split_forces(pushes)[0]
    some = magnitude > 0.0
    if not some.any():
        return None
    return Gp(likelihood_rows=MAX_LENGTH_LOADS, max_rows=MAX_CONDITIONING_LOADS).fit(
        compute_correction_features(patch, pushes)[some], (error[some] / magnitude[some])[:, None]
    )

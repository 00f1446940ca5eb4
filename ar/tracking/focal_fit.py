"""Check of a calibrated focal length against images of markers with known geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, minimize_scalar

from ..optics.camera import Camera
from .pose import PoseSettings, compute_pose_residual
from .targets import DetectedCorners, Target

MAX_RELATIVE_ERROR = 0.05  # Relative difference above which a focal length may be wrong.
# Difference above which a focal length is wrong [standard deviations], if above MAX_RELATIVE_ERROR as well.
MAX_DEVIATIONS = 6.0


@dataclass(frozen=True)
class FocalFitSettings:
    """Settings of `fit_focal_length`."""

    min_corners: int = 12  # Minimum number of corners in a view.
    factor_bounds: tuple[float, float] = (0.5, 2.0)  # Search range of the factor on the focal length.
    factor_tolerance: float = 1e-3  # Tolerance of the factor.
    factor_step: float = 0.02  # Step of the factor in the finite difference for the curvature of the sum of squares.


@dataclass(frozen=True)
class FocalFit:
    """Factor on a camera's focal lengths that fits observed markers best, and its standard deviation `deviation`."""

    factor: float
    deviation: float

    @property
    def is_significant(self) -> bool:
        """True if the factor differs significantly from 1: the calibrated focal length is wrong."""
        return abs(self.factor - 1.0) > max(MAX_RELATIVE_ERROR, MAX_DEVIATIONS * self.deviation)


def fit_focal_length(
    camera: Camera, observed: Sequence[tuple[Target, DetectedCorners]], settings: FocalFitSettings = FocalFitSettings()
) -> FocalFit | None:
    """Estimate the factor on both focal lengths that fits targets' corners best; None if there are too few corners.

    Each target has its best-fitting pose. The standard deviation is that of least squares: from the curvature of the
    sum of squares at its minimum and the residual variance. Source: Triggs et al. 2000, "Bundle adjustment: a modern
    synthesis", section 6.1.
    """
    enough = [(target, corners) for target, corners in observed if len(corners.points) >= settings.min_corners]
    freedom = sum(2 * len(corners.points) - 6 for _, corners in enough) - 1
    if freedom <= 0:
        return None

    def compute_squares(factor: float) -> float:
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= factor
        return sum(compute_pose_residual(replace(camera, K=K), target, corners) for target, corners in enough)

    options = {"xatol": settings.factor_tolerance}
    found = minimize_scalar(compute_squares, bounds=settings.factor_bounds, method="bounded", options=options)
    assert isinstance(found, OptimizeResult)
    around = compute_squares(found.x - settings.factor_step), compute_squares(found.x + settings.factor_step)
    if not np.isfinite([found.fun, *around]).all() or sum(around) <= 2.0 * found.fun:
        return None
    bend = (sum(around) - 2.0 * found.fun) / settings.factor_step**2
    variance = max(found.fun / freedom, PoseSettings.min_deviation**2)
    return FocalFit(float(found.x), float(np.sqrt(2.0 * variance / bend)))

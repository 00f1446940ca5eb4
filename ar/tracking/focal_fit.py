"""Whether a focal length is that of the pictures: markers whose places are known fit one alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, minimize_scalar

from ..optics.camera import Camera
from .pose import LEAST, squares_of
from .targets import Corners, Target

# Views with fewer corners say little. Where it is looked for, as a factor, and how exactly.
FEWEST, BOUNDS, EXACT = 12, (0.5, 2.0), 1e-3
# Two steps of the factor tell how sharp the least sum of squares is.
STEP = 0.02
# A focal length that is off by more than this share, and by so many standard deviations, is another one.
TOLERATED, SURE = 0.05, 6.0


@dataclass(frozen=True)
class FocalFit:
    """By what `factor` a camera's focal lengths fit markers best, and its standard deviation."""

    factor: float
    deviation: float

    @property
    def differs(self) -> bool:
        """Whether it is surely another focal length."""
        return abs(self.factor - 1.0) > max(TOLERATED, SURE * self.deviation)


def focal_fit(camera: Camera, seen: Sequence[tuple[Target, Corners]]) -> FocalFit | None:
    """The factor of both focal lengths with which poses of targets fit their corners best; None: too few are seen.

    Each target has the pose that fits it best. The deviation is that of least squares, by the curvature of the sum at
    its minimum and the variance that is left of corners. Source: Triggs et al. 2000, "Bundle adjustment: a modern
    synthesis", section 6.1.
    """
    enough = [(target, corners) for target, corners in seen if len(corners.points) >= FEWEST]
    freedom = sum(2 * len(corners.points) - 6 for _, corners in enough) - 1
    if freedom <= 0:
        return None

    def squares(factor: float) -> float:
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= factor
        return sum(squares_of(replace(camera, K=K), target, corners) for target, corners in enough)

    found = minimize_scalar(squares, bounds=BOUNDS, method="bounded", options={"xatol": EXACT})
    assert isinstance(found, OptimizeResult)
    around = squares(found.x - STEP), squares(found.x + STEP)
    if not np.isfinite([found.fun, *around]).all() or sum(around) <= 2.0 * found.fun:
        return None
    bend = (sum(around) - 2.0 * found.fun) / STEP**2
    variance = max(found.fun / freedom, LEAST**2)
    return FocalFit(float(found.x), float(np.sqrt(2.0 * variance / bend)))

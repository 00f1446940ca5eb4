"""Range of a model's training loads: outside it, a prediction is marked as extrapolated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from sim.loads import Pushed

from ..array_functions import compute_squared_distances
from ..data.cortex_patch import Patch
from ..data.encode import split_forces
from ..data.indentation import Indented

# Tolerance of lengths [m], angles [rad] and relative forces, so that round-off puts no training load outside.
RANGE_TOLERANCE = 1e-6


class Measured(NamedTuple):
    """Force [N], angle to the inward normal [rad], footprint beyond the edge of the craniotomy [m]: (B,) each."""

    magnitude: np.ndarray
    angle: np.ndarray
    overhang: np.ndarray


class Outside(NamedTuple):
    """Position of loads relative to the training range, (B,) each.

    `away` is the distance from the nearest training load [m]. `beyond` measures how far a load leaves the range
    otherwise: the largest of millimetres over the edge, radians beyond the angle, and three relative excesses, of
    force, radius and force over radius. `excess` includes millimetres beyond the reach, and is zero inside.
    """

    away: np.ndarray
    beyond: np.ndarray
    excess: np.ndarray

    @property
    def here(self) -> Outside:
        """Position with all distances zero, as of training loads."""
        return Outside(*(0.0 * each for each in self))


@dataclass(frozen=True, eq=False)
class Envelope:
    """Bounds of the training loads.

    Parameters
    ----------
    points
        Points (n, 3) of the training loads [m].
    reach
        Largest distance of a training point from its nearest neighbour [m]: how densely they cover the cortex.
    overhang
        Largest footprint radius minus distance to the edge [m].
    angle
        Largest angle [rad] between force and inward normal.
    force
        Smallest and largest [N]. Below the smallest the response is in proportion, so weaker loads are inside.
    footprint
        Smallest and largest radius [m].
    line_force
        Largest force over radius [N/m], to which the indentation of a round tool is in proportion.
    """

    points: np.ndarray
    reach: float
    overhang: float
    angle: float
    force: tuple[float, float]
    footprint: tuple[float, float]
    line_force: float

    def is_inside(self, patch: Patch, pushed: Pushed) -> np.ndarray:
        """Return the mask (B,) of loads inside the range."""
        return self.locate_outside(pushed, measure_loads(patch, pushed)).excess == 0.0

    def is_training_point(self, point: np.ndarray, corners: np.ndarray) -> bool:
        """Return True if any of the points (B, 3) [m] is exactly a training point.

        The surface's corners (n, 3) [m] do not count: many different poses have the same nearest corner.
        """
        asked, known, free = (set(map(tuple, place.astype(np.float32))) for place in (point, self.points, corners))
        return bool((asked & known) - free)

    def clip_to_range(self, known: Measured) -> Measured:
        """Return loads with forces clipped to the training range."""
        return known._replace(magnitude=np.clip(known.magnitude, *self.force))

    def locate_outside(self, pushed: Pushed, known: Measured) -> Outside:
        """Compute the position of loads relative to the range."""
        magnitude, angle, overhang = known
        away = np.sqrt(compute_squared_distances(pushed.point, self.points).min(axis=1))
        beyond = np.stack(
            [
                1e3 * (overhang - self.overhang - RANGE_TOLERANCE),
                np.where(magnitude == 0.0, 0.0, angle - self.angle - RANGE_TOLERANCE),
                magnitude / self.force[1] - 1.0 - RANGE_TOLERANCE,
                magnitude / (self.line_force * pushed.footprint) - 1.0 - RANGE_TOLERANCE,
                self.footprint[0] / pushed.footprint - 1.0 - RANGE_TOLERANCE,
                pushed.footprint / self.footprint[1] - 1.0 - RANGE_TOLERANCE,
            ]
        )
        beyond = np.maximum(beyond.max(axis=0), 0.0)
        return Outside(away, beyond, np.maximum(beyond, 1e3 * (away - self.reach - RANGE_TOLERANCE)))


def compute_training_range(patch: Patch, trained: Pushed) -> Envelope:
    """Compute the envelope of the training loads, from these loads alone."""
    magnitude, angle, overhang = measure_loads(patch, trained)
    return Envelope(
        trained.point.astype(np.float32),
        _compute_reach(trained.point),
        float(overhang.max()),
        float(angle.max()),
        (float(magnitude.min()), float(magnitude.max())),
        (float(trained.footprint.min()), float(trained.footprint.max())),
        float((magnitude / trained.footprint).max()),
    )


def _compute_reach(point: np.ndarray) -> float:
    """Compute the largest distance [m] of a point (n, 3) from its nearest neighbour: zero for a single point."""
    if len(point) < 2:
        return 0.0
    return float(KDTree(point).query(point, 2)[0][:, 1].max())


def measure_loads(patch: Patch, pushed: Pushed) -> Measured:
    """Measure loads for the envelope; for a rod or a blade the shaft's angle counts if it is larger."""
    (magnitude, direction), inward = split_forces(pushed), patch.find_normals(pushed.point)
    cosine = np.einsum("bi,bi->b", direction, inward)
    if isinstance(pushed, Indented):
        cosine = np.minimum(cosine, -np.einsum("bi,bi->b", pushed.axes[:, :, 2], inward))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return Measured(magnitude, angle, pushed.footprint - patch.compute_edge_distance(pushed.point))

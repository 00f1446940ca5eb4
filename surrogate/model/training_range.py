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


class LoadMeasures(NamedTuple):
    """Force [N], angle to the inward normal [rad], footprint beyond the edge of the craniotomy [m]: (B,) each."""

    magnitude: np.ndarray
    angle: np.ndarray
    overhang: np.ndarray


class Excess(NamedTuple):
    """Position of loads relative to the training range, (B,) each.

    `distance` is that from the nearest training load [m]. `bound_excess` measures how far a load leaves the range
    otherwise: the largest of millimetres over the edge, radians beyond the angle, and three relative excesses, of
    force, radius and force over radius. `excess` includes millimetres beyond the reach, and is zero inside.
    """

    distance: np.ndarray
    bound_excess: np.ndarray
    excess: np.ndarray

    @property
    def zero(self) -> Excess:
        """Position with all distances zero, as of training loads."""
        return Excess(*(0.0 * each for each in self))


@dataclass(frozen=True, eq=False)
class TrainingRange:
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

    def is_inside(self, patch: Patch, pushes: Pushed) -> np.ndarray:
        """Return the mask (B,) of loads inside the range."""
        return self.compute_excess(pushes, measure_loads(patch, pushes)).excess == 0.0

    def is_training_point(self, point: np.ndarray, corners: np.ndarray) -> bool:
        """Return True if any of the points (B, 3) [m] is exactly a training point.

        The surface's corners (n, 3) [m] do not count: many different poses have the same nearest corner.
        """
        asked, known, free = (set(map(tuple, place.astype(np.float32))) for place in (point, self.points, corners))
        return bool((asked & known) - free)

    def clip_to_range(self, measures: LoadMeasures) -> LoadMeasures:
        """Return loads with forces clipped to the training range."""
        return measures._replace(magnitude=np.clip(measures.magnitude, *self.force))

    def compute_excess(self, pushes: Pushed, measures: LoadMeasures) -> Excess:
        """Compute the position of loads relative to the range."""
        magnitude, angle, overhang = measures
        away = np.sqrt(compute_squared_distances(pushes.point, self.points).min(axis=1))
        beyond = np.stack(
            [
                1e3 * (overhang - self.overhang - RANGE_TOLERANCE),
                np.where(magnitude == 0.0, 0.0, angle - self.angle - RANGE_TOLERANCE),
                magnitude / self.force[1] - 1.0 - RANGE_TOLERANCE,
                magnitude / (self.line_force * pushes.footprint) - 1.0 - RANGE_TOLERANCE,
                self.footprint[0] / pushes.footprint - 1.0 - RANGE_TOLERANCE,
                pushes.footprint / self.footprint[1] - 1.0 - RANGE_TOLERANCE,
            ]
        )
        beyond = np.maximum(beyond.max(axis=0), 0.0)
        return Excess(away, beyond, np.maximum(beyond, 1e3 * (away - self.reach - RANGE_TOLERANCE)))


def compute_training_range(patch: Patch, pushes: Pushed) -> TrainingRange:
    """Compute the envelope of the training loads, from these loads alone."""
    magnitude, angle, overhang = measure_loads(patch, pushes)
    return TrainingRange(
        pushes.point.astype(np.float32),
        _compute_reach(pushes.point),
        float(overhang.max()),
        float(angle.max()),
        (float(magnitude.min()), float(magnitude.max())),
        (float(pushes.footprint.min()), float(pushes.footprint.max())),
        float((magnitude / pushes.footprint).max()),
    )


def _compute_reach(point: np.ndarray) -> float:
    """Compute the largest distance [m] of a point (n, 3) from its nearest neighbour: zero for a single point."""
    if len(point) < 2:
        return 0.0
    return float(KDTree(point).query(point, 2)[0][:, 1].max())


def measure_loads(patch: Patch, pushes: Pushed) -> LoadMeasures:
    """Measure loads for the envelope; for a rod or a blade the shaft's angle counts if it is larger."""
    (magnitude, direction), inward = split_forces(pushes), patch.find_normals(pushes.point)
    cosine = np.einsum("bi,bi->b", direction, inward)
    if isinstance(pushes, Indented):
        cosine = np.minimum(cosine, -np.einsum("bi,bi->b", pushes.axes[:, :, 2], inward))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return LoadMeasures(magnitude, angle, pushes.footprint - patch.compute_edge_distance(pushes.point))

"""Training range of a model: predictions for loads outside this range are marked as extrapolated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from sim.loads import Pushed

from ..array_functions import compute_squared_distances
from ..data.cortex_patch import Patch
from ..data.encode import split_forces
from ..data.indentation import IndentationPushes

# Tolerance of lengths [m], angles [rad] and relative forces, so that no training load is outside by round-off.
RANGE_TOLERANCE = 1e-6


class LoadMeasures(NamedTuple):
    """Force [N], angle to the inward normal [rad], and footprint overhang at the craniotomy's edge [m], (B,) each."""

    magnitude: np.ndarray
    angle: np.ndarray
    overhang: np.ndarray


class Excess(NamedTuple):
    """Distances (B,) of loads from the training range; all are arrays with one entry per load.

    `distance` [m] is measured from the nearest training point. `bound_excess` is the largest excess over the other
    limits: overhang in mm, angle in rad, and the relative excesses of force, radius and force over radius. `excess`
    also includes the distance beyond `TrainingRange.reach` in mm, and is zero inside the range.
    """

    distance: np.ndarray
    bound_excess: np.ndarray
    excess: np.ndarray

    @property
    def zero(self) -> Excess:
        """Excess of the same length with all values zero, as for training loads."""
        return Excess(*(0.0 * each for each in self))


@dataclass(frozen=True, eq=False)
class TrainingRange:
    """Bounds of the training loads.

    Parameters
    ----------
    points
        Points (n, 3) of the training loads [m].
    reach
        Largest distance [m] from a training point to its nearest neighbour; it measures the sampling density.
    overhang
        Largest difference [m] between the footprint's radius and its distance to the craniotomy's edge.
    angle
        Largest angle [rad] between force and inward normal.
    force
        Smallest and largest force [N]. Weaker loads are inside, as the response below is proportional to force.
    footprint
        Smallest and largest radius [m].
    line_force
        Largest ratio of force to radius [N/m], to which the indentation by a round tool is proportional.
    """

    points: np.ndarray
    reach: float
    overhang: float
    angle: float
    force: tuple[float, float]
    footprint: tuple[float, float]
    line_force: float

    def is_inside(self, patch: Patch, pushes: Pushed) -> np.ndarray:
        """Return the mask (B,) of loads inside the training range."""
        return self.compute_excess(pushes, measure_loads(patch, pushes)).excess == 0.0

    def is_training_point(self, point: np.ndarray, corners: np.ndarray) -> bool:
        """Return True if at least one of the points (B, 3) [m] equals a training point in single precision.

        The surface's corners (n, 3) [m] do not count, since many different poses have the same nearest corner.
        """
        asked, known, free = (set(map(tuple, place.astype(np.float32))) for place in (point, self.points, corners))
        return bool((asked & known) - free)

    def clip_to_range(self, measures: LoadMeasures) -> LoadMeasures:
        """Return the measures with forces clipped to the training range's smallest and largest force."""
        return measures._replace(magnitude=np.clip(measures.magnitude, *self.force))

    def compute_excess(self, pushes: Pushed, measures: LoadMeasures) -> Excess:
        """Compute by how much loads exceed the training range: distance, overhang, angle, force and footprint."""
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
    """Compute the training range from the training loads."""
    magnitude, angle, overhang = measure_loads(patch, pushes)
    return TrainingRange(
        pushes.point.astype(np.float32),
        _compute_max_spacing(pushes.point),
        float(overhang.max()),
        float(angle.max()),
        (float(magnitude.min()), float(magnitude.max())),
        (float(pushes.footprint.min()), float(pushes.footprint.max())),
        float((magnitude / pushes.footprint).max()),
    )


def _compute_max_spacing(points: np.ndarray) -> float:
    """Compute the largest distance [m] from a point (n, 3) to its nearest neighbour; zero for a single point."""
    if len(points) < 2:
        return 0.0
    return float(KDTree(points).query(points, 2)[0][:, 1].max())


def measure_loads(patch: Patch, pushes: Pushed) -> LoadMeasures:
    """Compute the measures of loads; the angle of a rod or a blade is the larger of its force's and its shaft's."""
    (magnitude, direction), inward = split_forces(pushes), patch.find_normals(pushes.point)
    cosine = np.einsum("bi,bi->b", direction, inward)
    if isinstance(pushes, IndentationPushes):
        cosine = np.minimum(cosine, -np.einsum("bi,bi->b", pushes.axes[:, :, 2], inward))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return LoadMeasures(magnitude, angle, pushes.footprint - patch.compute_edge_distance(pushes.point))

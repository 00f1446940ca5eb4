"""Observers of the open cortex, which estimate the tumour position without measured force, stiffness or load."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ar.overlay.hud import format_millimetres
from ar.rendering.layer import Layer
from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from surrogate.locating.calibration import RADIUS_SQUARED
from surrogate.locating.evidence import compute_correlation_root
from surrogate.locating.locator import Location, Locator
from surrogate.locating.observation import Observation
from surrogate.locating.prior import compute_centroid_motion

from ..script.craniotomy_frame import HOLE_RATIO, CraniotomyFrame
from ..script.observation_models import PointObservation, StereoObservation
from ..script.tool import build_sphere

TOUCH_DISTANCE = 1e-3  # Distance from the cortex within which a tool touches it [m].
HIDING_DISTANCE = 4e-3  # Distance from a tool within which points are hidden [m].
# Number of tool corners, nearest to those of the cortex, that are searched for the contact point.
SEARCHED_CORNERS = 32
ELLIPSOID_COLOUR = (0.21, 0.30, 0.90)  # Colour of the ellipsoid (RGB, 0 to 1).
ELLIPSOID = 5
"""Segmentation id of the ellipsoid's layer, which no image contains."""
SPHERE, SPHERE_FACES = build_sphere()  # Unit sphere: vertices and triangles.
NO_POINTS = Observation(np.zeros((0, 3)))
"""Empty observation."""


@dataclass(frozen=True, eq=False)
class TumourEstimate:
    """Estimated tumour position in one frame, with the ground truth.

    Parameters
    ----------
    anatomy
        Undeformed anatomy.
    observation
        Observed points.
    location
        Result of the locator; None if the locator rejects the observation.
    rejection
        The locator's reason to reject the observation; empty if the observation is accepted.
    centroid, true_motion
        Centroid (3,) [m] of the tumour in the scan, and true displacement (3,) [m] of the centroid.
    seconds
        Time of observation and localisation [s].
    """

    anatomy: Anatomy
    observation: Observation
    location: Location | None
    rejection: str
    centroid: np.ndarray
    true_motion: np.ndarray
    seconds: float

    @property
    def motion(self) -> np.ndarray:
        """Estimated displacement (3,) [m] of the tumour centroid; zero if the observation is rejected."""
        return np.zeros(3) if self.location is None else self.location.centroid

    @property
    def motion_length(self) -> float:
        """Length [m] of `motion`."""
        return float(np.linalg.norm(self.motion))

    @property
    def error_bound(self) -> float | None:
        """95 % bound on the error of the tumour vertex with the largest variance [m]; None after a rejection."""
        if self.location is None:
            return None
        largest = np.linalg.eigvalsh(self.location.compute_covariance(self.anatomy.tumour_nodes))[:, -1].max()
        return float(np.sqrt(RADIUS_SQUARED * largest))

    @property
    def true_distance(self) -> float:
        """True displacement of the tumour centroid [m]."""
        return float(np.linalg.norm(self.true_motion))

    @property
    def error(self) -> float:
        """Error of the estimated tumour centroid [m]."""
        return float(np.linalg.norm(self.motion - self.true_motion))

    @property
    def is_significant(self) -> bool:
        """True if the estimated motion is larger than the 95th percentile of its error."""
        return self.location is not None and self.motion_length > self.location.p95

    @property
    def is_covered(self) -> bool:
        """True if the ellipsoid contains the true tumour centroid; false if the observation is rejected."""
        if self.location is None:
            return False
        away = self.true_motion - self.motion
        return bool(away @ np.linalg.solve(self.location.centroid_covariance, away) <= RADIUS_SQUARED)

    @property
    def remark(self) -> str:
        """Remark for the image: true motion and estimation error; empty if the observation is rejected."""
        if self.location is None:
            return ""
        still = "" if self.is_significant else "no significant motion detected; "
        guess = "" if self.location.calibrated else "rough estimate; "
        motion, error = format_millimetres(self.true_distance), format_millimetres(self.error)
        return f"{still}{guess}simulated motion {motion}; estimate error {error}"

    @property
    def source(self) -> str:
        """Description of the observation, or the reason why the locator rejected the observation."""
        if self.location is None:
            return f"rejected, {self.rejection}"
        tip = ", and where the tool touches" if len(self.observation.tips) else ""
        return f"{len(self.observation.now)} points of the cortex{tip}; no force, no stiffness"

    def place_tumour(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (V, 3) [m] with the tumour's vertices at their estimated positions."""
        nodes, believed = self.anatomy.tumour_nodes, positions.copy()
        believed[nodes] = self.anatomy.mesh.nodes[nodes]
        if self.location is not None:
            believed[nodes] += self.location.compute_motion(nodes)
        return believed

    def build_ellipsoid(self) -> Layer | None:
        """Return the surface that contains the tumour centroid with a probability of 95 %; None after a rejection."""
        if self.location is None:
            return None
        root = np.linalg.cholesky(self.location.centroid_covariance)
        at = np.sqrt(RADIUS_SQUARED) * SPHERE @ root.T
        return Layer("ellipsoid", ELLIPSOID, self.centroid + self.motion + at, SPHERE_FACES, ELLIPSOID_COLOUR)


class TumourObserver(Protocol):
    """Protocol of an observer, which estimates the tumour position in the frames of a scene from observations."""

    def estimate(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> TumourEstimate:
        """Estimate the tumour position in frame `frame_number`, for a body at `positions` (V, 3) [m].

        `corners` (t, 3) [m] are the corners of the tool's surface, if there is one: its pose is observed.
        """
        ...


@dataclass(frozen=True, eq=False)
class PointObserver:
    """Observer that samples the points and errors of a `PointObservation`, and locates the tumour without loads."""

    site: CraniotomyFrame
    locator: Locator
    observation_model: PointObservation

    def estimate(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> TumourEstimate:
        """Estimate the tumour position in frame `frame_number`, for a body at `positions` (V, 3) [m].

        `corners` (t, 3) [m] are the corners of the tool's surface, if there is one: its pose is observed.
        """
        begun = clock.perf_counter()
        return locate_tumour(
            self.site.anatomy, self.locator, lambda: self.observe(frame_number, positions, corners), positions, begun
        )

    def observe(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> Observation:
        """Sample the observation of a frame; for the arguments see `estimate`."""
        model, random = self.observation_model, np.random.default_rng([self.observation_model.seed, 1 + frame_number])
        now = self._interpolate_points(positions)
        off = self._smooth + model.white * random.standard_normal(now.shape)
        shown, tips = np.ones(len(now), bool), np.zeros((0, 3))
        if corners is not None:
            shown = KDTree(corners).query(now)[0] > HIDING_DISTANCE
            tips = find_touched_point(self.site.anatomy, positions, corners)
            tips = self._move_rigid(tips + model.white * random.standard_normal(tips.shape))
        sigma = np.full(shown.sum(), np.hypot(model.white, model.smooth))
        return Observation(self._move_rigid(now + off)[shown], self._interpolate_points(self._rest)[shown], sigma, tips)

    @property
    def _rest(self) -> np.ndarray:
        return self.site.anatomy.mesh.nodes

    def _interpolate_points(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate the observed points (n, 3) [m] from mesh vertices at `positions` (V, 3) [m]."""
        vertices, weights = self._places
        return np.einsum("nc,nci->ni", weights, positions[vertices])

    def _move_rigid(self, points: np.ndarray) -> np.ndarray:
        """Add the rigid error to points (n, 3) [m]."""
        return self._rigid.apply(points, self._interpolate_points(self._rest).mean(axis=0))

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Mesh vertices (n, 3) and barycentric weights (n, 3) of the observed points."""
        site, random = self.site, np.random.default_rng([self.observation_model.seed, 0])
        triangles = site.anatomy.open_surface
        corners = self._rest[triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        area *= (site.compute_axis_distance(corners.reshape(-1, 3)).reshape(-1, 3) < HOLE_RATIO * site.clearance).all(
            axis=1
        )
        some = random.choice(len(area), self.observation_model.points, p=area / area.sum())
        return triangles[some], random.dirichlet(np.ones(3), len(some))

    @cached_property
    def _smooth(self) -> np.ndarray:
        """Spatially correlated noise (n, 3) [m]."""
        at, random = self._interpolate_points(self._rest), np.random.default_rng([self.observation_model.seed, 0, 1])
        return self.observation_model.smooth * compute_correlation_root(at) @ random.standard_normal(at.shape)

    @cached_property
    def _rigid(self) -> RigidError:
        return sample_rigid_error(self.observation_model, 2)


@dataclass(frozen=True, eq=False)
class RigidError:
    """Rigid registration error of all observations: a rotation vector (3,) [rad], and a translation (3,) [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Apply the rigid error to points (n, 3) [m], with the rotation about a centre (3,) [m]."""
        return centre + Rotation.from_rotvec(self.rotation).apply(points - centre) + self.translation


def sample_rigid_error(model: PointObservation | StereoObservation, number: int) -> RigidError:
    """Return the `number`-th sample of an observation model's rigid registration error."""
    turn, shift = np.random.default_rng([model.seed, 0, number]).standard_normal((2, 3))
    return RigidError(model.turn * turn / np.linalg.norm(turn), model.shift * shift / np.linalg.norm(shift))


def find_touched_point(anatomy: Anatomy, positions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Find the point (1, 3) [m] of the cortex that a tool with surface corners (t, 3) [m] touches.

    The result has the shape (0, 3) if the tool does not touch the cortex. `positions` (V, 3) [m] are the mesh vertices.
    """
    triangles = anatomy.open_surface
    near = corners[np.argsort(KDTree(positions[np.unique(triangles)]).query(corners)[0])[:SEARCHED_CORNERS]]
    place = find_closest_points(near, positions[triangles]).point
    away = np.linalg.norm(place - near, axis=1)
    return place[[away.argmin()]] if away.min() < TOUCH_DISTANCE else NO_POINTS.now


def locate_tumour(
    anatomy: Anatomy, locator: Locator, observe: Callable[[], Observation], positions: np.ndarray, start_time: float
) -> TumourEstimate:
    """Locate the tumour from an observation, with the truth from `positions` (V, 3) [m]; a rejection raises no error.

    `start_time` is the start time of the measurement, by `time.perf_counter`.
    """
    observation, location, refusal = NO_POINTS, None, ""
    try:
        observation = observe()
        location = locator.locate(observation)
    except InputError as error:
        refusal = str(error)
    seconds, rest = clock.perf_counter() - start_time, anatomy.mesh.nodes
    middle, true = compute_centroid_motion(anatomy, np.stack([rest, positions - rest]))
    return TumourEstimate(anatomy, observation, location, refusal, middle, true, seconds)

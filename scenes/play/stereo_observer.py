"""Observer of the open cortex in stereo images of a microscope, which estimates the tumour position."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from surrogate.locating.locator import Locator
from surrogate.locating.observation import Observation

from ..script.observation_models import StereoObservation
from .observer import NO_POINTS, RigidError, TumourEstimate, find_touched_point, locate_tumour, sample_rigid_error
from .stage import Stage
from .stereo_update import FirstView, StereoPair, observe_first_pair, observe_point_cloud, observe_points


@dataclass(frozen=True, eq=False)
class StereoObserver:
    """Observer that renders both eyes' images, with camera noise, and locates the tumour from both. Loads are not used.

    `stage` is the rendered stage.
    """

    stage: Stage
    locator: Locator
    observation_model: StereoObservation

    def estimate(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> TumourEstimate:
        """Estimate the tumour in a frame; arguments: see `PointObserver.estimate`. Rendering time is not counted."""
        shot, anatomy = self.render_pair(frame_number, positions, corners), self.stage.site.anatomy
        tips = NO_POINTS.now if corners is None else find_touched_point(anatomy, positions, corners)
        _ = self._first_shot  # rendered here, so that its time is not counted
        begun = clock.perf_counter()
        return locate_tumour(anatomy, self.locator, lambda: self.observe(shot, tips), positions, begun)

    def observe(self, pair: StereoPair, contact_points: np.ndarray) -> Observation:
        """Extract the observation from a stereo pair, with contact points of a tool, `contact_points` (k, 3) [m].

        Raises
        ------
        InputError
            See `observe_points`, or `observe_point_cloud` without correspondences; see also `observe_first_pair`.
        """
        site, model = self.stage.site, self.observation_model
        if not model.named:
            return observe_point_cloud(site, pair, model.points, self._build_microscope(0), contact_points)
        return observe_points(site, self.first_view, pair, self._build_microscope(1), contact_points)

    def render_pair(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> StereoPair:
        """Render both eyes' images of a frame, for positions (V, 3) [m] and a tool's corners (t, 3) [m].

        Number -1 is before the first frame.
        """
        scene = self.stage.scene
        time = float(scene.times[min(max(frame_number, 0), len(scene.times) - 1)])
        left, right = (
            replace(scene.viewpoint, eye=eye).build_camera(self.stage.site, time) for eye in ("left", "right")
        )
        pictures = [
            self._add_noise(stage.render_with_corners(camera, positions, corners).colour, frame_number, eye)
            for eye, (stage, camera) in enumerate(zip(self._stages, (left, right), strict=True))
        ]
        seen = None if corners is None or scene.tool is None else (corners, np.asarray(scene.tool.mesh.faces))
        return StereoPair((left, right), (pictures[0], pictures[1]), seen)

    @cached_property
    def first_view(self) -> FirstView:
        """First image pair, of the brain as in the scan.

        Raises
        ------
        InputError
            See `observe_first_pair`.
        """
        return observe_first_pair(
            self.stage.site, self._first_shot, self.observation_model.points, self._build_microscope(0)
        )

    @cached_property
    def _first_shot(self) -> StereoPair:
        return self.render_pair(-1, self.stage.site.anatomy.mesh.nodes)

    @cached_property
    def _stages(self) -> tuple[Stage, Stage]:
        """Stages of the two cameras: a stage caches the image of its last camera."""
        return replace(self.stage), replace(self.stage)

    def _add_noise(self, picture: np.ndarray, number: int, eye: int) -> np.ndarray:
        """Add camera noise to an image (H, W, 3) uint8; the image of the right camera (1) is darker."""
        random = np.random.default_rng([self.observation_model.seed, 2 + number, eye])
        noise = self.observation_model.noise * random.standard_normal(picture.shape, np.float32)
        lit = np.float32(1.0 - eye * self.observation_model.darker) * picture + noise
        return np.clip(np.rint(lit), 0.0, 255.0).astype(np.uint8)

    def _build_microscope(self, number: int) -> MicroscopeTrackingError:
        return MicroscopeTrackingError(sample_rigid_error(self.observation_model, 2 + number), self.stage.site.origin)


@dataclass(frozen=True, eq=False)
class MicroscopeTrackingError:
    """Rigid error of a tracked microscope about the centre (3,) [m] of the craniotomy."""

    error: RigidError
    centre: np.ndarray

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Return positions (n, 3) [m] with the tracking error."""
        return self.error.apply(places, self.centre)

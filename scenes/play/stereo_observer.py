"""Observer that estimates the tumour position from stereo images of a microscope."""

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
    """Observer that renders noisy images of both eyes and locates the tumour from this stereo pair, without loads.

    `stage`: rendered parts of the scene.
    """

    stage: Stage
    locator: Locator
    observation_model: StereoObservation

    def estimate(self, frame_number: int, positions: np.ndarray, corners: np.ndarray | None = None) -> TumourEstimate:
        """Estimate the tumour position in a frame, without rendering in `seconds`; see `PointObserver.estimate`."""
        shot, anatomy = self.render_pair(frame_number, positions, corners), self.stage.site.anatomy
        tips = NO_POINTS.now if corners is None else find_touched_point(anatomy, positions, corners)
        _ = self._first_shot  # rendered here, so that its time is not counted
        begun = clock.perf_counter()
        return locate_tumour(anatomy, self.locator, lambda: self.observe(shot, tips), positions, begun)

    def observe(self, pair: StereoPair, contact_points: np.ndarray) -> Observation:
        """Extract the observation from a stereo pair; `contact_points` (k, 3) [m] are points where a tool touches.

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
        """Render the stereo pair of a frame, for mesh vertices at `positions` (V, 3) [m] and tool corners (t, 3) [m].

        Frame number -1 is the state before the first frame.
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
        """Matched first image pair, which shows the undeformed brain.

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
        """One stage for each camera, because a stage caches the background of its last camera."""
        return replace(self.stage), replace(self.stage)

    def _add_noise(self, image: np.ndarray, number: int, eye: int) -> np.ndarray:
        """Add camera noise to an image (H, W, 3) uint8, and darken the image of the right eye (1)."""
        random = np.random.default_rng([self.observation_model.seed, 2 + number, eye])
        noise = self.observation_model.noise * random.standard_normal(image.shape, np.float32)
        lit = np.float32(1.0 - eye * self.observation_model.darker) * image + noise
        return np.clip(np.rint(lit), 0.0, 255.0).astype(np.uint8)

    def _build_microscope(self, number: int) -> MicroscopeTrackingError:
        return MicroscopeTrackingError(sample_rigid_error(self.observation_model, 2 + number), self.stage.site.origin)


@dataclass(frozen=True, eq=False)
class MicroscopeTrackingError:
    """Rigid tracking error of a microscope, with its rotation about the centre (3,) [m] of the craniotomy."""

    error: RigidError
    centre: np.ndarray

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """Add the tracking error to positions (n, 3) [m]."""
        return self.error.apply(positions, self.centre)

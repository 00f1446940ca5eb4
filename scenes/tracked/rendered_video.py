"""Short rendered test video with temporarily covered markers, and exactly known motion of the brain."""

import time as clock
from dataclasses import dataclass, replace

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.image_sequences import NamedImage, to_named_image
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Deformer
from sim.loads import Loads, Touching
from surrogate.model.learned import build_prediction

from ..play.deformers import PatientSetup
from ..play.player import Player
from ..play.stage import Stage
from ..script.camera_paths import HandHeld
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.scene import find_scene
from ..script.viewpoint import PLAIN_APPEARANCE
from .filming import (
    USUAL_CALIBRATION,
    VIEW,
    Artefacts,
    Disturbance,
    Mounts,
    VideoFrame,
    mount_targets,
    render_frames,
    scale_distance,
)

SCENE = "palpate"
"""Scene of the video."""
CAMERA = USUAL_CALIBRATION.resize_calibration(800, 600, allow_scaling=True)
"""Camera of the video, with fewer pixels than usual, so that rendering takes only seconds."""
FRAME_RATE = 10.0  # Frame rate [1/s].
DURATION = 1.7  # Length of the video [s].
START_TIME = 0.5  # Start time in the scene [s]: the ball makes contact at 0.4 s.
# Covered targets and gaps, with their times [s].
DISTURBANCES = (Disturbance("reference", 0.25, 0.55), Disturbance("tool", 0.85, 1.05), Disturbance("gap", 1.25, 1.55))
TISSUE_SPREAD = 25e-3  # Standard deviation of the tissue displacement around a tool's tip [m].


@dataclass(frozen=True, eq=False)
class DentDeformer:
    """Deformer by a formula: tissue moves with the tool's tip, by a share that decreases with distance from the tip."""

    anatomy: Anatomy
    site: CraniotomyFrame

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Compute the deformation for tool poses; tissue at a tip moves by the tip's depth below the open cortex."""
        nodes = self.anatomy.mesh.nodes
        cause = loads.get(Touching)
        assert cause is not None
        moved = []
        for tip in cause.pose[:, 0, :3, 3]:
            place = self.site.find_nearest(tip).point
            depth = max(0.0, float((tip - place) @ self.site.axis))
            share = np.exp(-np.square(nodes - place).sum(axis=1) / (2.0 * TISSUE_SPREAD**2))
            moved.append(depth * share[:, None] * self.site.axis)
        exact = np.zeros((2, len(loads)))
        found = build_prediction(
            np.stack(moved), np.arange(len(nodes)), loads, [False] * len(loads), clock.perf_counter(), exact, ""
        )
        return found if at is None else found.restrict(at)


@dataclass(frozen=True, eq=False)
class RenderedVideo:
    """Rendered video: images with their ground truth, and the scene that they show.

    Parameters
    ----------
    stage, targets, calibration, deformer
        Rendered parts of the scene, printed targets, camera, and deformer that computes the true motion.
    frames
        Images in temporal order.
    degradation
        Image degradation, including the covered targets and their times.
    """

    stage: Stage
    targets: Mounts
    calibration: Calibration
    deformer: Deformer
    frames: tuple[VideoFrame, ...]
    degradation: Artefacts

    def get_image(self, frame: VideoFrame) -> NamedImage:
        """Convert an image to the type that a video reader yields."""
        return to_named_image(f"{frame.time:.1f} s", frame.image, frame.time)


def render_synthetic_video(patient: PatientSetup) -> RenderedVideo:
    """Render the test video on a patient's anatomy.

    Raises
    ------
    InputError
        The anatomy has no open cortex.
    """
    view = replace(VIEW.calibrate(CAMERA), path=HandHeld(0))
    whole = find_scene(SCENE)
    scene = replace(
        whole, path=lambda time: whole.path(time + START_TIME), viewpoint=scale_distance(view),
        frames_per_second=FRAME_RATE, duration=DURATION, look=PLAIN_APPEARANCE,
    )  # fmt: skip
    stage = patient.build_stage(scene)
    deformer = DentDeformer(patient.anatomy, stage.site)
    player = Player(stage, deformer)
    mounts, taking = mount_targets(player), Artefacts(disturbances=DISTURBANCES)
    return RenderedVideo(stage, mounts, CAMERA, deformer, tuple(render_frames(player, mounts, taking)), taking)

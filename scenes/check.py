"""Whether a scene's pictures can be trusted: figures of every frame, and the bounds that they must keep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ar.camera import Camera, project_cv2
from ar.overlay import iou, silhouette
from sim.deformation import Deformation

from .play import Frame, Player
from .scene import Bounds


@dataclass(frozen=True)
class Figures:
    """The worst of a scene's frames.

    Parameters
    ----------
    overlap
        Intersection over union of the drawn tumour's silhouette and that of the finite elements, seen by the scene's
        own camera.
    error_mm, motion_mm
        Mean distance over the tumour's nodes between prediction and finite elements, and the largest mean motion [mm].
    pixels
        Distance between the drawn camera's projection of the tumour and OpenCV's for the scene's camera [pixel].
    finite, answered
        Whether every number and picture is finite, and every answer, drawn or by finite elements, a good one.
    in_step
        Whether every picture shows the answer to its own moment.
    """

    overlap: float
    error_mm: float
    motion_mm: float
    pixels: float
    finite: bool
    answered: bool
    in_step: bool

    def broken(self, bounds: Bounds) -> list[str]:
        """A sentence for each bound that is not kept."""
        rules = {
            f"overlap {self.overlap:.4f} is below {bounds.overlap}": self.overlap >= bounds.overlap,
            f"error {self.error_mm:.4f} mm is above {1e3 * bounds.error:g} mm": self.error_mm <= 1e3 * bounds.error,
            f"projection is {self.pixels:.3g} pixels off, more than {bounds.pixels:g}": self.pixels <= bounds.pixels,
            "the tumour never moves: nothing was shown": self.motion_mm > 0.0,
            "a number is not finite": self.finite,
            "an answer is not good: see its outcome": self.answered,
            "a picture shows the answer to another moment": self.in_step,
        }
        return [sentence for sentence, kept in rules.items() if not kept]

    def row(self) -> dict[str, float | bool]:
        """For machines."""
        return asdict(self)


def measure(player: Player, camera: Camera, frames: Sequence[Frame], truth: Deformation) -> Figures:
    """Hold drawn frames against the finite elements' answers to the same loads (one row per frame).

    `camera` is the one that should have drawn them.
    """
    nodes = player.site.anatomy.tumour_nodes
    right = truth.at(nodes).displacement
    overlap, error, pixels, finite, answered, in_step = [], [], [], [], [], []
    for row, frame in enumerate(frames):
        shown = player.stage.tumour(player.positions(frame.deformation))
        true = player.stage.tumour(player.positions(truth, row))
        drawn = silhouette(frame.camera, shown.vertices, shown.triangles)
        overlap.append(iou(drawn, silhouette(camera, true.vertices, true.triangles)))
        guess = frame.deformation.at(nodes).displacement[0]
        error.append(np.linalg.norm(guess - right[row], axis=1).mean())
        ours = frame.camera.project(shown.vertices)[0]
        off = np.linalg.norm(ours - project_cv2(camera, shown.vertices), axis=1).max()
        pixels.append(np.inf if np.isnan(off) else off)  # NaN: behind the camera
        finite.append(np.isfinite(frame.picture.depth).all() and np.isfinite(guess).all() and np.isfinite(ours).all())
        answered.append(frame.deformation.outcome[0].good and truth.outcome[row].good)
        in_step.append(frame.deformation.time[0] == frame.time == truth.time[row])
    return Figures(
        overlap=float(np.min(overlap)),
        error_mm=1e3 * float(np.max(error)),
        motion_mm=1e3 * float(np.linalg.norm(right, axis=2).mean(axis=1).max()),
        pixels=float(np.max(pixels)),
        finite=bool(np.all(finite)),
        answered=all(answered),
        in_step=bool(np.all(in_step)),
    )

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

NOWHERE = 0.0, np.inf, np.inf
"""How far off a tumour is whose place is no number: overlap, distance [m], distance in the picture [pixel]."""


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

    def row(self) -> dict[str, float | bool | None]:
        """For machines: JSON knows no infinity, so None is a figure that could not be measured."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


def measure(player: Player, camera: Camera, frames: Sequence[Frame], truth: Deformation) -> Figures:
    """Hold drawn frames against the finite elements' answers to the same loads (one row per frame).

    `camera` is the one that should have drawn them.
    """
    moved = [
        np.linalg.norm(truth.at(player.stage.at(frame.loads).anatomy.tumour_nodes).displacement[row], axis=1).mean()
        for row, frame in enumerate(frames)
    ]
    finite = [_finite(frame) for frame in frames]
    misses = [_miss(player, camera, frame, truth, row) if finite[row] else NOWHERE for row, frame in enumerate(frames)]
    overlap, error, pixels = zip(*misses, strict=True)
    return Figures(
        overlap=min(overlap),
        error_mm=1e3 * max(error),
        motion_mm=1e3 * float(max(moved)),
        pixels=max(pixels),
        finite=all(finite),
        answered=all(frame.deformation.outcome[0].good for frame in frames) and all(o.good for o in truth.outcome),
        in_step=all(
            bool(frame.deformation.time[0] == frame.time == time)
            for frame, time in zip(frames, truth.time, strict=True)
        ),
    )


def _finite(frame: Frame) -> bool:
    return bool(np.isfinite(frame.picture.depth).all() and np.isfinite(frame.deformation.displacement).all())


def _miss(player: Player, camera: Camera, frame: Frame, truth: Deformation, row: int) -> tuple[float, float, float]:
    """Overlap, mean distance [m] and largest distance in the picture [pixel] between a frame and the truth."""
    stage = player.stage.at(frame.loads)
    shown = stage.tumour(player.positions(frame.deformation))
    true = stage.tumour(player.positions(truth, row))
    drawn = silhouette(frame.camera, shown.vertices, shown.triangles)
    overlap = iou(drawn, silhouette(camera, true.vertices, true.triangles))
    nodes = stage.anatomy.tumour_nodes
    off = frame.deformation.at(nodes).displacement[0] - truth.at(nodes).displacement[row]
    ours = frame.camera.project(shown.vertices)[0]
    pixels = np.linalg.norm(ours - project_cv2(camera, shown.vertices), axis=1).max()
    # Not a number: behind the camera.
    return overlap, float(np.linalg.norm(off, axis=1).mean()), np.inf if np.isnan(pixels) else float(pixels)

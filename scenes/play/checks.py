"""Whether a scene's pictures can be trusted: figures of every frame, and the bounds that they must keep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ar.camera import Camera, project_cv2
from ar.hud import FINE, WHITE, millimetres
from ar.layer import Layer
from ar.overlay import DOUBTFUL, GAUGE, ink_of, iou, silhouette
from ar.raycast import raycast
from ar.refind import outline_gap, stands
from sim.deformation import Deformation
from surrogate.model.learned import Learned

from ..script.scene import Bounds
from .player import Frame, Player
from .stage import TOOL, TUMOUR_COLOUR

# Barycentric weights (q, 3) at which the tumour's triangles are sampled: corners, edges and insides.
STEPS = 24
SAMPLES = np.array([(i, j, STEPS - i - j) for i in range(STEPS + 1) for j in range(STEPS + 1 - i)]) / STEPS

NOWHERE = 0.0, np.inf, np.inf, np.inf
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
    drawn
        Distance between the outline in the picture itself, found again by its colour, and that of the finite elements'
        tumour by another renderer [pixel]. 95 in 100 of the outline's pixels are nearer.
    printed
        Whether the picture says the frame's number and the distance from tip to tumour, as they are computed here.
    finite, answered
        Whether every number and picture is finite, and every answer, drawn or by finite elements, a good one.
    doubt
        The first answer that is not: frame, whose it is, and its outcome; how many more there are.
    in_step
        Whether every picture shows the answer to its own moment.
    leaked
        The volume that passes the closed skull in the finite elements' answers, as a share of what the opening takes
        in and gives out. It is reported and has no limit: see docs/verification.md.
    bond
        The largest traction between brain and skull, as a share of what their bond bears: above 1 it would tear. NaN
        where nothing is bonded. It is reported and has no limit.
    """

    overlap: float
    error_mm: float
    motion_mm: float
    pixels: float
    drawn: float
    printed: bool
    finite: bool
    answered: bool
    in_step: bool
    leaked: float
    bond: float
    doubt: str = ""

    def broken(self, bounds: Bounds) -> list[str]:
        """A sentence for each bound that is not kept."""
        rules = {
            f"overlap {self.overlap:.4f} is below {bounds.overlap}": self.overlap >= bounds.overlap,
            f"error {self.error_mm:.4f} mm is above {1e3 * bounds.error:g} mm": self.error_mm <= 1e3 * bounds.error,
            f"projection is {self.pixels:.3g} pixels off, more than {bounds.pixels:g}": self.pixels <= bounds.pixels,
            f"the drawn outline is {self.drawn:.1f} pixels off, more than {bounds.drawn:g}": self.drawn <= bounds.drawn,
            "a picture does not say its frame's number or the distance to the tumour": self.printed,
            "the tumour never moves: nothing was shown": self.motion_mm > 0.0,
            "a number is not finite": self.finite,
            f"an answer is not good: {self.doubt}": self.answered,
            "a picture shows the answer to another moment": self.in_step,
        }
        return [sentence for sentence, kept in rules.items() if not kept]

    def row(self) -> dict[str, float | bool | str | None]:
        """For machines: JSON knows no infinity, so None is a figure that could not be measured."""
        figures = asdict(self)
        return {name: value if name == "doubt" or np.isfinite(value) else None for name, value in figures.items()}


def measure(player: Player, camera: Camera, frames: Sequence[Frame], truth: Deformation) -> Figures:
    """Hold drawn frames against the finite elements' answers to the same loads (one row per frame).

    `camera` is the one that should have drawn them.
    """
    doubts = _doubts(frames, truth)
    moved = [
        np.linalg.norm(truth.at(player.stage.at(frame.loads).anatomy.tumour_nodes).displacement[row], axis=1).mean()
        for row, frame in enumerate(frames)
    ]
    finite = [_finite(frame) for frame in frames]
    misses = [_miss(player, camera, frame, truth, row) if finite[row] else NOWHERE for row, frame in enumerate(frames)]
    overlap, error, pixels, drawn = zip(*misses, strict=True)
    return Figures(
        overlap=min(overlap),
        error_mm=1e3 * max(error),
        motion_mm=1e3 * float(max(moved)),
        pixels=max(pixels),
        drawn=max(drawn),
        printed=all(good and _printed(player, frame) for good, frame in zip(finite, frames, strict=True)),
        finite=all(finite),
        answered=not doubts,
        in_step=all(
            bool(frame.deformation.time[0] == frame.time == time)
            for frame, time in zip(frames, truth.time, strict=True)
        ),
        leaked=float(truth.leaked.max()),
        bond=float(truth.bond.max()),
        doubt="" if not doubts else doubts[0] + (f" ({len(doubts) - 1} more)" if doubts[1:] else ""),
    )


def _doubts(frames: Sequence[Frame], truth: Deformation) -> list[str]:
    """Which frames, drawn or by finite elements, are not answered well, and why."""
    found = []
    for frame, true in zip(frames, truth.outcome, strict=True):
        outcomes = {"as drawn": frame.deformation.outcome[0], "by the finite elements": true}
        found += [f"frame {frame.number} {whose}, {one.value}" for whose, one in outcomes.items() if not one.good]
    return found


def _finite(frame: Frame) -> bool:
    return bool(np.isfinite(frame.picture.depth).all() and np.isfinite(frame.deformation.displacement).all())


def _miss(player: Player, camera: Camera, frame: Frame, truth: Deformation, row: int) -> tuple[float, ...]:
    """Between a frame and the truth: overlap, mean distance [m], largest in the picture [pixel], and the outline's."""
    stage = player.stage.at(frame.loads)
    shown = stage.tumour(player.positions(frame.deformation))
    true = stage.tumour(player.positions(truth, row))
    drawn = silhouette(frame.camera, shown.vertices, shown.triangles)
    overlap = iou(drawn, silhouette(camera, true.vertices, true.triangles))
    nodes = stage.anatomy.tumour_nodes
    off = frame.deformation.at(nodes).displacement[0] - truth.at(nodes).displacement[row]
    ours = frame.camera.project(shown.vertices)[0]
    pixels = np.linalg.norm(ours - project_cv2(camera, shown.vertices), axis=1).max()
    mean = float(np.linalg.norm(off, axis=1).mean())
    # Not a number: behind the camera.
    return overlap, mean, np.inf if np.isnan(pixels) else float(pixels), _drawn(camera, frame, true)


def _drawn(camera: Camera, frame: Frame, true: Layer) -> float:
    """How far the outline in a frame's picture is from where the finite elements have it [pixel]."""
    mask = raycast(camera, true.vertices, true.triangles).mask
    ink = ink_of(DOUBTFUL if frame.doubt else TUMOUR_COLOUR)
    words = (frame.shown == np.asarray(WHITE, np.uint8)).all(axis=2)
    return outline_gap(frame.shown, ink, mask, (frame.picture.segmentation == TOOL) | words)


def _printed(player: Player, frame: Frame) -> bool:
    """Whether a picture says its frame's number, and how far the tip is from the tumour: both as found here."""
    if not stands(frame.shown, f"frame {frame.number}", FINE):
        return False
    if frame.tip is None:
        return True
    distance = _distance(player, frame, frame.tip)
    error = None if frame.doubt else frame.distance_error
    # Samples are never nearer than the surface: by less than what is printed.
    near = {millimetres(distance - off, error) for off in (0.0, 0.5e-4, 1e-4)}
    return any(stands(frame.shown, text, GAUGE) for text in near)


def _distance(player: Player, frame: Frame, tip: np.ndarray) -> float:
    """From tip to tumour [m] by samples of the drawn surfaces, with what the model knows it to be off by."""
    positions = player.positions(frame.deformation)
    corners = positions[player.stage.at(frame.loads).anatomy.tumour_surface]
    apart = float(np.linalg.norm(np.einsum("qc,scx->sqx", SAMPLES, corners) - tip, axis=2).min())
    if not isinstance(player.deformer, Learned):
        return apart
    return float(player.deformer.distance(frame.loads, frame.deformation, np.array([apart])).value[0])

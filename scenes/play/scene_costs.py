"""Computation times of a frame, shown on a panel in its image, and on one sheet for all scenes."""

from dataclasses import dataclass

import numpy as np

from ar.overlay.hud import HEAD_ROW, LINE_SPACING, draw_text_panel, format_bound
from ar.screen import shrink_image

from .frame_text import shorten_source
from .player import Frame, Player
from .stage import DRAPE, TOOL

RENDERED_FRAMES = 8  # Number of frames rendered of each scene, evenly spaced; the first loads kernels and is not timed.
IMAGE_SIZE = (480, 360)  # Width and height of an image of the sheet [pixel].
LINE_LEGEND = "green estimate, pink simulated (FEM), blue 95 % of its centre"
"""Legend of the lines drawn with an estimate."""


def list_cost_lines(frame: Frame, deformer: str) -> list[str]:
    """Build the text lines of a frame's panel, the most important line first; `deformer` is the deformer's name."""
    answer, found = frame.deformation, frame.estimate
    source, spent = shorten_source(answer.source or deformer), frame.seconds.items()
    doubt = [] if answer.outcome[0].good else [answer.outcome[0].value]
    moment = f"t {frame.time:.2f} s{', ' if frame.acts else ''}{frame.acts}"
    rest = [*doubt, moment, "ms: " + ", ".join(f"{stage} {1e3 * seconds:.1f}" for stage, seconds in spent)]
    if found is None:
        return [f"{deformer}: tumour moved {_format_length(frame.moved, frame.moved_error)}", *rest, source]
    moved = [f"simulated tumour motion: {1e3 * found.true_distance:.2f} mm"]
    if found.location is not None:
        moved.append(f"estimate: tumour moved {_format_length(found.motion_length, frame.moved_error)}")
    lines = [] if frame.named else [f"lines: {LINE_LEGEND}"]
    return [*moved, *rest, f"simulation: {source}", f"estimate: {found.source}", *lines]


def _format_length(length: float, error: float | None) -> str:
    """Format a length [m] in millimetres, with its error [m] unless the error is None."""
    return f"{1e3 * length:.2f} {'mm' if error is None else f'+- {format_bound(error, 1)}'}"


def draw_cost_panel(frame: Frame, deformer: str) -> np.ndarray:
    """Return the shown image (H, W, 3) with a panel: deformer, loads, times by stage [ms], and the estimate if any."""
    seen = frame.picture.segmentation
    # The panel may hide cortex, but no tool, line or text.
    hides = (frame.taken > 0) | (seen != DRAPE), (frame.taken > 0) | (seen == TOOL)
    sights = [each.view(np.uint8) for each in hides]
    return draw_text_panel(
        frame.shown,
        list_cost_lines(frame, deformer),
        first_row=HEAD_ROW + LINE_SPACING * len(frame.head),
        obstacles=sights,
    )


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Image (H, W, 3) uint8, median time of a frame by stage [ms], and the tumour's largest mean displacement [mm]."""

    image: np.ndarray
    milliseconds: dict[str, float]
    motion_mm: float

    @property
    def total_milliseconds(self) -> float:
        """Total time of a frame, summed over the stages [ms]."""
        return sum(self.milliseconds.values())


def render_thumbnail(player: Player, deformer: str) -> Thumbnail:
    """Render a small image of the frame with the largest tumour motion after the last resection step of a scene."""
    every = max(1, (len(player.scene.times) - 1) // (RENDERED_FRAMES - 1))
    frames = list(player.play_frames(every))
    best = max(frames, key=lambda frame: (_count_cuts(player, frame), frame.moved))
    labelled = draw_cost_panel(best, deformer)
    taken = best.taken | (labelled != best.shown).any(axis=2).view(np.uint8)
    picture = draw_text_panel(labelled, [player.scene.name], "top right", 0.9, obstacles=[taken])
    return Thumbnail(
        shrink_image(picture, *IMAGE_SIZE),
        _compute_medians(frames[1:] or frames),
        1e3 * max(frame.moved for frame in frames),
    )


def _count_cuts(player: Player, frame: Frame) -> int:
    left = player.stage.select_stage(frame.loads).remaining_body
    return 0 if left is None else left.steps_done


def _compute_medians(frames: list[Frame]) -> dict[str, float]:
    return {stage: 1e3 * float(np.median([frame.seconds[stage] for frame in frames])) for stage in frames[0].seconds}


def tile_images(images: list[np.ndarray], columns: int = 3) -> np.ndarray:
    """Arrange images (H, W, 3) uint8 of equal size in rows on one sheet; empty cells are dark."""
    blank = np.full_like(images[0], 12)
    whole = [*images, *[blank] * (-len(images) % columns)]
    return np.concatenate(
        [np.concatenate(whole[first : first + columns], axis=1) for first in range(0, len(whole), columns)]
    )

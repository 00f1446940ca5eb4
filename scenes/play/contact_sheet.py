"""A sheet of all scenes: of each its clearest picture, with what a frame costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ar.overlay.hud import panel
from ar.screen import shrunk

from .label import labelled
from .player import Frame, Player

# Frames that are drawn of each scene, evenly spaced; the first loads kernels and is not timed.
DRAWN = 8
# Width and height of a picture of the sheet [pixel].
SIZE = (480, 360)


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A picture (H, W, 3) uint8; median milliseconds of a frame by stage; the tumour's largest mean motion [mm]."""

    colour: np.ndarray
    milliseconds: dict[str, float]
    moved_mm: float

    @property
    def total(self) -> float:
        """Milliseconds of a whole frame."""
        return sum(self.milliseconds.values())


def thumbnail(player: Player, name: str) -> Thumbnail:
    """The frame of a deformer `name` in which the tumour has moved most, of those after the last cut, small."""
    every = max(1, (len(player.scene.times) - 1) // (DRAWN - 1))
    frames = list(player.frames(every))
    best = max(frames, key=lambda frame: (_cuts(player, frame), frame.moved))
    said = labelled(best, name)
    taken = best.taken | (said != best.shown).any(axis=2).view(np.uint8)
    picture = panel(said, [player.scene.name], "top right", 0.9, sights=[taken])
    return Thumbnail(shrunk(picture, *SIZE), _medians(frames[1:] or frames), 1e3 * max(frame.moved for frame in frames))


def _cuts(player: Player, frame: Frame) -> int:
    left = player.stage.at(frame.loads).left
    return 0 if left is None else left.done


def _medians(frames: list[Frame]) -> dict[str, float]:
    return {stage: 1e3 * float(np.median([frame.seconds[stage] for frame in frames])) for stage in frames[0].seconds}


def sheet(pictures: list[np.ndarray], columns: int = 3) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of one size side by side in rows, dark where there is none."""
    blank = np.full_like(pictures[0], 12)
    whole = [*pictures, *[blank] * (-len(pictures) % columns)]
    return np.concatenate(
        [np.concatenate(whole[first : first + columns], axis=1) for first in range(0, len(whole), columns)]
    )

"""What a network or a nearest neighbour is given of a frame, and how it is scaled and mirrored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from frames import AXES, FORCE, POSE, Frames

COLOURS, ALL_CHANNELS = 3, 4


@dataclass(frozen=True)
class Inputs:
    """Which of a frame's measurements are given: channels of its picture, its pose, its force."""

    name: str
    channels: int = 0
    pose: bool = False
    force: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of the numbers beside the picture."""
        return (*(POSE if self.pose else ()), *(FORCE if self.force else ()))

    def numbers(self, frames: Frames) -> np.ndarray:
        """The numbers (n, k) float32."""
        given = [*([frames.pose] if self.pose else []), *([frames.force] if self.force else [])]
        return np.concatenate(given, axis=1) if given else np.zeros((len(frames), 0), np.float32)


POSE_ALONE = Inputs("pose", pose=True)
PICTURE_AND_POSE = Inputs("picture, pose", ALL_CHANNELS, pose=True)
INPUTS = (
    POSE_ALONE,
    Inputs("picture", ALL_CHANNELS),
    PICTURE_AND_POSE,
    Inputs("colour, pose", COLOURS, pose=True),
    Inputs("pose, force", pose=True, force=True),
    Inputs("picture, pose, force", ALL_CHANNELS, pose=True, force=True),
)
"""`picture` is colour and depth."""


@dataclass(frozen=True, eq=False)
class Scale:
    """Means and deviations (k,) of the training frames' numbers, and the root mean square [mm] of their labels."""

    mean: np.ndarray
    deviation: np.ndarray
    size: float

    @classmethod
    def of(cls, inputs: Inputs, training: Frames) -> Scale:
        """Of training frames alone."""
        size = float(np.sqrt(np.square(training.label).sum(axis=1).mean()))
        return cls(*spread_of(inputs.numbers(training)), size or 1.0)

    def scaled(self, inputs: Inputs, frames: Frames) -> np.ndarray:
        """Numbers (n, k) with mean 0 and deviation 1 in training."""
        return ((inputs.numbers(frames) - self.mean) / self.deviation).astype(np.float32)


def spread_of(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and deviations (k,) of numbers (n, k); of those that do not differ the deviation is taken as 1."""
    deviation = numbers.std(axis=0)
    return numbers.mean(axis=0), np.where(deviation > 1e-6, deviation, 1.0)


def mirrored(
    inputs: Inputs,
    scale: Scale,
    picture: torch.Tensor,
    numbers: torch.Tensor,
    label: torch.Tensor,
    draws: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A batch in which each frame is mirrored left to right, and upside down, each by chance.

    Mechanics and camera know no left and right: a mirrored frame is as true as the first. Vectors are mirrored with it.
    """
    signs = 1.0 - 2.0 * torch.randint(0, 2, (len(label), 2), generator=draws, device=label.device).float()
    for axis, dimension in ((0, 3), (1, 2)):
        turned = (signs[:, axis] < 0.0)[:, None, None, None]
        picture = torch.where(turned, picture.flip(dimension), picture) if inputs.channels else picture
    signs = torch.cat([signs, torch.ones_like(signs[:, :1])], dim=1)
    place = torch.tensor([AXES.find(name[-1]) if name[-2] == "_" else 2 for name in inputs.names], dtype=torch.long)
    if len(place):
        mean = torch.as_tensor(scale.mean / scale.deviation, device=numbers.device, dtype=numbers.dtype)
        numbers = (numbers + mean) * signs[:, place.to(signs.device)] - mean
    return picture, numbers, label * signs

"""The nearest training frames: what any network must be better than."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from frames import Frames
from inputs import Inputs, Scale
from torch.nn.functional import adaptive_avg_pool2d

COUNTS = (1, 3, 10, 30)
"""How many neighbours are tried on the frames that are set aside."""
COMPONENTS = 16
SEEN_SIZE = (9, 12)


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Training frames as points (n, d), their labels (n, 3) [mm], and how many of them answer together.

    Of pictures the points have principal components (p, k) of very small ones, which weigh as much as all numbers.
    """

    inputs: Inputs
    scale: Scale
    mean: torch.Tensor
    components: torch.Tensor
    points: torch.Tensor
    label: torch.Tensor
    count: int = 1

    def answers(self, frames: Frames) -> np.ndarray:
        """Mean displacements (n, 3) [mm] of the nearest."""
        return self.by_count(frames, [self.count])[0]

    def by_count(self, frames: Frames, counts: list[int]) -> list[np.ndarray]:
        """The same for each number of neighbours."""
        found = []
        for some in self.placed(frames).split(512):
            nearest = torch.cdist(some, self.points).topk(min(max(counts), len(self.points)), largest=False).indices
            found.append([self.label[nearest[:, :count]].mean(dim=1) for count in counts])
        return [torch.cat(parts).cpu().numpy() for parts in zip(*found, strict=True)]

    def placed(self, frames: Frames) -> torch.Tensor:
        """Frames as points (n, d)."""
        numbers = torch.from_numpy(self.scale.scaled(self.inputs, frames)).to(self.label.device)
        if not self.inputs.channels:
            return numbers
        seen = (_small(self.inputs, frames, self.label.device) - self.mean) @ self.components
        return torch.cat([numbers, seen], dim=1)


def neighbours(inputs: Inputs, training: Frames, aside: Frames, device: torch.device) -> Neighbours:
    """Nearest neighbours in training frames; as many as answer the frames set `aside` best."""
    scale, label = Scale.of(inputs, training), torch.from_numpy(training.label).to(device)
    mean = components = torch.zeros(0, device=device)
    if inputs.channels:
        small = _small(inputs, training, device)
        mean = small.mean(dim=0)
        _, sizes, axes = torch.linalg.svd(small - mean, full_matrices=False)
        sizes, axes = sizes[:COMPONENTS], axes[:COMPONENTS]
        whole = float(sizes.square().sum()) / len(small)
        weight = np.sqrt(max(len(inputs.names), 1) / max(whole, 1e-12))
        components = weight * axes.T
    found = Neighbours(inputs, scale, mean, components, label[:0], label)
    found = Neighbours(inputs, scale, mean, components, found.placed(training), label)
    errors = [np.linalg.norm(one - aside.label, axis=1).mean() for one in found.by_count(aside, list(COUNTS))]
    count = COUNTS[int(np.argmin(errors))]
    return Neighbours(inputs, scale, mean, components, found.points, label, count)


def _small(inputs: Inputs, frames: Frames, device: torch.device) -> torch.Tensor:
    """Very small pictures (n, p)."""
    found = []
    for start in range(0, len(frames), 1024):
        picture = torch.from_numpy(np.ascontiguousarray(frames.picture[start : start + 1024, ..., : inputs.channels]))
        small = adaptive_avg_pool2d(picture.to(device).permute(0, 3, 1, 2).float() / 255.0, SEEN_SIZE)
        found.append(small.flatten(1))
    return torch.cat(found)

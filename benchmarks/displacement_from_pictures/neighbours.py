"""The nearest training frames: what any network must be better than."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from frames import FORCE, POSE, Frames
from inputs import Inputs, spread_of
from torch.nn.functional import adaptive_avg_pool2d

COUNTS = (1, 3, 10, 30)
"""How many neighbours are tried on the frames that are set aside."""
COMPONENTS = 16
SEEN_SIZE = (9, 12)
PLACED = ("opening", "opening_normal", "tool", "tool_axis", "force")
ALONE = ("tumour_radius", "tool_radius", "tool_known", "force_known")
"""Where the camera is does not make two frames alike."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Training frames as points (n, d), their labels (n, 3) [mm], and how many of them answer together.

    Where a pose is given, vectors and labels are in the axes of the scan, so that it does not matter how the camera is
    held; else labels are in the camera's. Of pictures the points have principal components (p, k) of very small ones,
    which weigh as much as all numbers.
    """

    inputs: Inputs
    mean: np.ndarray
    deviation: np.ndarray
    seen_mean: torch.Tensor
    components: torch.Tensor
    points: torch.Tensor
    label: torch.Tensor
    count: int = 1

    def answers(self, frames: Frames) -> np.ndarray:
        """Mean displacements (n, 3) [mm] of the nearest, in the camera's axes."""
        return self.by_count(frames, [self.count])[0]

    def by_count(self, frames: Frames, counts: Sequence[int]) -> list[np.ndarray]:
        """The same for each number of neighbours."""
        found = []
        for some in self.placed(frames).split(512):
            nearest = torch.cdist(some, self.points).topk(min(max(counts), len(self.points)), largest=False).indices
            found.append([self.label[nearest[:, :count]].mean(dim=1) for count in counts])
        answers = [torch.cat(parts).cpu().numpy() for parts in zip(*found, strict=True)]
        return [np.einsum("nij,nj->ni", frames.turn, one) for one in answers] if self.inputs.pose else answers

    def placed(self, frames: Frames) -> torch.Tensor:
        """Frames as points (n, d)."""
        numbers = (_numbers(self.inputs, frames) - self.mean) / self.deviation
        found = torch.from_numpy(numbers.astype(np.float32)).to(self.label.device)
        if not self.inputs.channels:
            return found
        seen = (_small(self.inputs, frames, self.label.device) - self.seen_mean) @ self.components
        return torch.cat([found, seen], dim=1)


def neighbours(inputs: Inputs, training: Frames, aside: Frames, device: torch.device) -> Neighbours:
    """Nearest neighbours in training frames; as many as answer the frames set `aside` best."""
    numbers = _numbers(inputs, training)
    label = in_scan(training, training.label) if inputs.pose else training.label
    mean = components = torch.zeros(0, device=device)
    if inputs.channels:
        small = _small(inputs, training, device)
        mean = small.mean(dim=0)
        _, sizes, axes = torch.linalg.svd(small - mean, full_matrices=False)
        whole = float(sizes[:COMPONENTS].square().sum()) / len(small)
        components = axes[:COMPONENTS].T * np.sqrt(max(numbers.shape[1], 1) / max(whole, 1e-12))
    known = torch.from_numpy(np.ascontiguousarray(label)).to(device)
    found = Neighbours(inputs, *spread_of(numbers), mean, components, known[:0], known)
    found = replace(found, points=found.placed(training))
    errors = [np.linalg.norm(one - aside.label, axis=1).mean() for one in found.by_count(aside, COUNTS)]
    return replace(found, count=COUNTS[int(np.argmin(errors))])


def in_scan(frames: Frames, vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) in the axes of the scan."""
    return np.einsum("nji,nj->ni", frames.turn, vectors)


def _numbers(inputs: Inputs, frames: Frames) -> np.ndarray:
    """What is near and far (n, k): vectors of the pose and the force in the axes of the scan, and other numbers."""
    found = [np.zeros((len(frames), 0), np.float32)]
    for given, names, values in ((inputs.pose, POSE, frames.pose), (inputs.force, FORCE, frames.force)):
        if given:
            place = {name: number for number, name in enumerate(names)}
            vectors = [name for name in PLACED if f"{name}_x" in place]
            found += [in_scan(frames, values[:, place[f"{name}_x"] : place[f"{name}_x"] + 3]) for name in vectors]
            found.append(values[:, [place[name] for name in ALONE if name in place]])
    return np.concatenate(found, axis=1)


def _small(inputs: Inputs, frames: Frames, device: torch.device) -> torch.Tensor:
    """Very small pictures (n, p)."""
    found = []
    for start in range(0, len(frames), 1024):
        picture = torch.from_numpy(np.ascontiguousarray(frames.picture[start : start + 1024, ..., : inputs.channels]))
        small = adaptive_avg_pool2d(picture.to(device).permute(0, 3, 1, 2).float() / 255.0, SEEN_SIZE)
        found.append(small.flatten(1))
    return torch.cat(found)

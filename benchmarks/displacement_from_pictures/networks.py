"""A small network from a picture and numbers to where the tumour's middle went, and how it is trained."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from frames import Frames
from inputs import Inputs, Scale, mirrored
from torch import nn

WIDTHS = (32, 64, 96, 128)
HIDDEN = 128


@dataclass(frozen=True)
class Training:
    """How a network is trained.

    Parameters
    ----------
    updates
        The most.
    batch
        Frames of each.
    rate
        The first step size, which falls to zero as a cosine.
    check_every
        Updates from one look at the frames that are set aside to the next.
    patience
        Looks without a better answer that end it.
    """

    updates: int = 3000
    batch: int = 256
    rate: float = 2e-3
    check_every: int = 100
    patience: int = 10


class Network(nn.Module):
    """Convolutions see the picture, a hidden layer the numbers; two layers join them. Less than a million weights."""

    def __init__(self, channels: int, numbers: int) -> None:
        super().__init__()
        self.sees = _sees(channels) if channels else None
        self.reads = _reads(numbers) if numbers else None
        joined = (32 * 4 * 5 if channels else 0) + (HIDDEN if numbers else 0)
        self.joins = nn.Sequential(
            nn.Linear(joined, 2 * HIDDEN), nn.ReLU(), nn.Linear(2 * HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 3)
        )

    def forward(self, picture: torch.Tensor, numbers: torch.Tensor) -> torch.Tensor:
        """Displacements (b, 3) of pictures (b, C, H, W) and numbers (b, k), all scaled."""
        found = [] if self.sees is None else [self.sees(picture)]
        found += [] if self.reads is None else [self.reads(numbers)]
        return self.joins(torch.cat(found, dim=1)).float()


def _sees(channels: int) -> nn.Module:
    layers: list[nn.Module] = []
    for before, after in pairwise((channels, *WIDTHS)):
        layers += [nn.Conv2d(before, after, 3, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d((4, 5)), nn.Conv2d(WIDTHS[-1], 32, 1), nn.Flatten())


def _reads(numbers: int) -> nn.Module:
    return nn.Sequential(nn.Linear(numbers, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU())


@dataclass(frozen=True, eq=False)
class Fitted:
    """A trained network, and what it was scaled by."""

    inputs: Inputs
    scale: Scale
    network: Network
    updates: int

    def answers(self, frames: Frames, batch: int = 1024) -> np.ndarray:
        """Displacements (n, 3) [mm]."""
        device = next(self.network.parameters()).device
        self.network.eval()
        found = []
        with torch.no_grad():
            for start in range(0, len(frames), batch):
                some = frames.at(np.arange(start, min(start + batch, len(frames))))
                picture, numbers, _ = tensors(self.inputs, self.scale, some, device)
                found.append(self.network(lit(picture), numbers).cpu().numpy())
        return self.scale.size * np.concatenate(found)


def tensors(
    inputs: Inputs, scale: Scale, frames: Frames, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pictures (n, C, H, W) uint8, numbers (n, k) and labels (n, 3), the last two scaled."""
    picture = torch.from_numpy(np.ascontiguousarray(frames.picture[..., : inputs.channels])).permute(0, 3, 1, 2)
    numbers = torch.from_numpy(scale.scaled(inputs, frames))
    return picture.to(device), numbers.to(device), torch.from_numpy(frames.label / scale.size).to(device)


def lit(picture: torch.Tensor, gain: torch.Tensor | float = 1.0) -> torch.Tensor:
    """Pictures as numbers about zero, with a gain of their colours (b, C, 1, 1)."""
    return gain * picture.float() / 128.0 - 1.0


def fitted(
    inputs: Inputs, training: Frames, aside: Frames, seed: int, device: torch.device, how: Training = Training()
) -> Fitted:
    """A network trained on frames; the weights that answer those set `aside` best are kept."""
    torch.manual_seed(seed)
    draws = torch.Generator(device).manual_seed(seed)
    scale = Scale.of(inputs, training)
    picture, numbers, label = tensors(inputs, scale, training, device)
    network = Network(inputs.channels, numbers.shape[1]).to(device)
    adam = torch.optim.AdamW(network.parameters(), how.rate, weight_decay=1e-2)
    falls = torch.optim.lr_scheduler.CosineAnnealingLR(adam, how.updates)
    best, kept, kept_at = np.inf, copy.deepcopy(network.state_dict()), 0
    for update in range(1, how.updates + 1):
        network.train()
        which = torch.randint(0, len(label), (how.batch,), generator=draws, device=device)
        seen, read, wanted = mirrored(inputs, scale, picture[which], numbers[which], label[which], draws)
        gain = torch.ones(len(which), inputs.channels, 1, 1, device=device)
        gain[:, :3] += 0.4 * torch.rand(gain[:, :3].shape, generator=draws, device=device) - 0.2
        with torch.autocast(device.type, torch.bfloat16, device.type == "cuda"):
            off = network(lit(seen, gain), read) - wanted
        loss = torch.sqrt(off.square().sum(dim=1) + 1e-6).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        falls.step()
        if update % how.check_every == 0 or update == how.updates:
            found = Fitted(inputs, scale, network, update).answers(aside)
            error = float(np.linalg.norm(found - aside.label, axis=1).mean())
            if error < best:
                best, kept, kept_at = error, copy.deepcopy(network.state_dict()), update
            elif update - kept_at >= how.patience * how.check_every:
                break
    network.load_state_dict(kept)
    return Fitted(inputs, scale, network, kept_at)

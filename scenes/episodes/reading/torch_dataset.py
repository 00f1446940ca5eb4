"""Episodes as a PyTorch data set, for a `DataLoader` with any number of workers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from .windows import Episodes, read_episodes


class EpisodeDataset(Dataset[dict[str, Any]]):
    """PyTorch data set of the windows of `read_episodes`, in the same order, as tensors; texts stay lists.

    Open files are not pickled: forked and spawned workers open their own files.
    """

    def __init__(
        self,
        paths: str | Path | Sequence[str | Path],
        keys: Sequence[str] | None = None,
        window: int = 1,
        step: int = 1,
        stride: int = 1,
        most_open: int = 16,
    ) -> None:
        """Read the contents of the files; for the arguments and the InputError see `read_episodes`."""
        self.episodes: Episodes = read_episodes(paths, keys, window, step, stride, most_open)

    def __len__(self) -> int:
        return len(self.episodes)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return window `index`, counted over all episodes."""
        return {name: _to_tensor(value) for name, value in self.episodes[index].items()}

    def get_window(self, episode: int, first: int) -> dict[str, Any]:
        """Return the window that begins at frame `first` of an episode; for errors see `Episodes.get_window`."""
        return {name: _to_tensor(value) for name, value in self.episodes.get_window(episode, first).items()}

    at = get_window  # Former names, for one release.


def _to_tensor(value: Any) -> Any:
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value

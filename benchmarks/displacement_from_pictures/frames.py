"""Frames of many episodes in one small file: reduced pictures, what is measured with them, and where the tumour is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import written_whole

AXES = "xyz"
VECTORS = ("tumour", "opening", "opening_normal", "tool", "tool_axis")
POSE = (*(f"{name}_{axis}" for name in VECTORS for axis in AXES), "tumour_radius", "focal", "tool_radius", "tool_known")
"""Numbers beside a picture: vectors in the axes of the camera as it is tracked, in millimetres or unit vectors.

`tumour` is the middle of the planned tumour from the camera; `opening` and `tool` are from that middle.
"""
FORCE = (*(f"force_{axis}" for axis in AXES), "force_known")
"""The force as it is read [N], in the same axes."""


@dataclass(frozen=True, eq=False)
class Frames:
    """n frames.

    Parameters
    ----------
    picture
        (n, H, W, 4) uint8: red, green, blue, and depth.
    pose, force
        (n, len(POSE)) and (n, len(FORCE)) float32; zero where there is no tool, or no force is read.
    turn
        (n, 3, 3) float32 takes directions of the scan to the axes of the tracked camera.
    label
        (n, 3) float32 displacement of the tumour's middle [mm] that networks are trained on, in the camera's axes.
    truth
        (n, 3) that of finite elements; NaN where they solved nothing, or the frame is not tested.
    usable
        (n,) whether the label may be relied on.
    episode, body, frame
        (n,) numbers.
    family
        (n,) what happens, by name.
    """

    picture: np.ndarray
    pose: np.ndarray
    force: np.ndarray
    turn: np.ndarray
    label: np.ndarray
    truth: np.ndarray
    usable: np.ndarray
    episode: np.ndarray
    body: np.ndarray
    frame: np.ndarray
    family: np.ndarray

    def __len__(self) -> int:
        return len(self.episode)

    @property
    def tested(self) -> np.ndarray:
        """(n,) whether finite elements know where the tumour is."""
        return np.isfinite(self.truth).all(axis=1)

    @property
    def episodes(self) -> np.ndarray:
        """Sorted numbers of the episodes."""
        return np.unique(self.episode)

    def at(self, which: np.ndarray) -> Frames:
        """Some frames, by a mask (n,) or by their places."""
        return Frames(**{name: value[which] for name, value in vars(self).items()})

    def of(self, episodes: np.ndarray) -> Frames:
        """All frames of some episodes."""
        return self.at(np.isin(self.episode, episodes))


def joined(parts: Sequence[Frames]) -> Frames:
    """Frames one after the other."""
    return Frames(
        **{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Frames)}
    )  # fmt: skip


def write_frames(path: Path, frames: Frames) -> None:
    """Write them; pictures as differences from the pixel before, which pack better.

    Raises
    ------
    InputError
        A file that cannot be written.
    """
    arrays = dict(vars(frames))
    arrays["picture"] = np.diff(frames.picture, axis=2, prepend=np.uint8(0))
    with written_whole(path, ".npz") as partial:
        np.savez_compressed(partial, **arrays)


def read_frames(paths: Sequence[Path]) -> Frames:
    """Frames of several files, one after the other.

    Raises
    ------
    InputError
        A file that is not there, or none of `extract`; pictures of several sizes; an episode that comes twice.
    """
    parts = [_read(path) for path in paths]
    if len({part.picture.shape[1:] for part in parts}) != 1:
        raise InputError(f"{paths[0]}: its pictures are not of the others' size. Extract them with the same --width.")
    numbers = np.concatenate([part.episodes for part in parts])
    if len(np.unique(numbers)) != len(numbers):
        raise InputError(f"{paths[0]}: an episode is in two of the files. Name each once.")
    return joined(parts)


def _read(path: Path) -> Frames:
    try:
        with np.load(path) as file:
            arrays = {one.name: file[one.name] for one in fields(Frames)}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: is not what `extract` writes ({error}). Extract it anew.") from error
    return Frames(**{**arrays, "picture": np.cumsum(arrays["picture"], axis=2, dtype=np.uint8)})

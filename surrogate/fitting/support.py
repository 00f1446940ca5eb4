"""Points of frames that no other point supports: an estimate of tissue takes none of them, as `locate` does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim.errors import InputError

from ..locating.locator import Locator
from .frame import Frame


def unsupported(locator: Locator, frames: Sequence[Frame]) -> tuple[np.ndarray, ...]:
    """Of each frame the numbers (k,) of points, from 0, that `Locator.locate` leaves out.

    Raises
    ------
    InputError
        A frame that no cause explains, or of which more than a third is left out.
    """
    found = []
    for number, frame in enumerate(frames, start=1):
        try:
            found.append(locator.locate(frame.observation).outliers)
        except InputError as error:
            raise InputError(f"frame {number}: {error}") from error
    return tuple(found)


def without(frames: Sequence[Frame], left_out: Sequence[np.ndarray]) -> list[Frame]:
    """Frames of points that have names, without those of some numbers (k,) in each."""
    return [
        _without(frame, numbers) if len(numbers) else frame for frame, numbers in zip(frames, left_out, strict=True)
    ]


def _without(frame: Frame, numbers: np.ndarray) -> Frame:
    seen = frame.observation
    assert seen.rest is not None
    kept = np.delete(np.arange(len(seen.now)), numbers)
    sigma = None if seen.sigma is None else seen.sigma[kept]
    return replace(frame, observation=replace(seen, now=seen.now[kept], rest=seen.rest[kept], sigma=sigma))

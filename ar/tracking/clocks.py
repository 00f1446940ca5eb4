"""By how much two clocks differ, from one body's motion as both have seen it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .pose_stream import LONGEST

# Offsets are tried so far apart, and then refined [s]; so many pictures are needed, and so many seconds are tried.
STEP, FEWEST, MOST_SECONDS = 0.01, 8, 900.0
# A body must move so far [m]; another offset, so far away [s], must fit worse by so many times, beyond this noise [m].
LEAST_MOVED, ANOTHER, CLEARLY, NOISE = 1e-3, 0.15, 2.0, 0.1e-3
ROUNDS = 20
MOVE = "Move the tool to and fro by centimetres, quickly and unevenly, while markers and poses are both seen."


@dataclass(frozen=True)
class Clock:
    """The tracker's time is the pictures' time + `offset` [s], which may be off by a deviation of `error` [s]."""

    offset: float = 0.0
    error: float = 0.0


def clock_by_motion(times: np.ndarray, places: np.ndarray, samples: np.ndarray, others: np.ndarray) -> Clock:
    """The offset at which a place moves alike in pictures (n,) [s], (n, 3) [m], and by a tracker (m,) [s], (m, 3) [m].

    Both places may lie apart by what does not change. The error is that of least squares, as residuals scatter.

    Raises
    ------
    ValueError
        Too few pictures, motion that is too small, no time at which poses are there for all pictures, or two offsets
        that fit about as well.
    """
    if len(times) < FEWEST:
        raise ValueError(f"{len(times)} pictures show what the poses have, and {FEWEST} are needed. {MOVE}")
    low, high = samples[0] - times[0], samples[-1] - times[-1]
    if high < low:
        raise ValueError("the poses end before the pictures do: record them for longer than the film.")
    if high - low > MOST_SECONDS:
        raise ValueError(f"the poses are {high - low:.0f} s longer than the film: cut them to {MOST_SECONDS:.0f} s.")
    tried = np.arange(low, high + STEP, STEP).clip(low, high)
    squares = np.array([_squares(_apart(times + offset, places, samples, others)) for offset in tried])
    if not np.isfinite(squares).any():
        raise ValueError(f"the poses have gaps of more than {LONGEST:g} s wherever the pictures are.")
    best = int(np.argmin(squares))
    clock, least = _refined(float(tried[best]), times, places, samples, others)
    walled = np.pad(squares, 1, constant_values=np.inf)
    valley = (squares <= walled[:-2]) & (squares <= walled[2:])
    far = np.where(valley & (np.abs(tried - tried[best]) > ANOTHER), squares, np.inf)
    if np.isfinite(far.min()):
        _, rival = _refined(float(tried[int(np.argmin(far))]), times, places, samples, others)
        if rival < CLEARLY * max(least, places.size * NOISE**2):
            raise ValueError(f"more than one offset of the clocks fits. {MOVE}")
    return clock


def _refined(
    offset: float, times: np.ndarray, places: np.ndarray, samples: np.ndarray, others: np.ndarray
) -> tuple[Clock, float]:
    """Gauss-Newton from an offset on, and the sum of squares [m^2] that is left."""
    low, high = samples[0] - times[0], samples[-1] - times[-1]
    speed, off = np.zeros_like(places), np.zeros_like(places)
    for _ in range(ROUNDS):
        off = _apart(times + offset, places, samples, others)
        ahead, behind = min(offset + STEP, high), max(offset - STEP, low)
        speed = _apart(times + ahead, places, samples, others) - _apart(times + behind, places, samples, others)
        speed /= max(ahead - behind, np.finfo(float).tiny)
        step = -float((speed * off).sum() / max((speed**2).sum(), np.finfo(float).tiny))
        offset = float(np.clip(offset + np.clip(step, -STEP, STEP), low, high))
        if abs(step) < 1e-6:
            break
    moved = float(np.sqrt((speed**2).sum(axis=1).mean())) * float(times[-1] - times[0])
    if not moved > LEAST_MOVED:
        raise ValueError(f"the tool moves by {1e3 * moved:.1f} mm only: that says nothing of the clocks. {MOVE}")
    left = _squares(_apart(times + offset, places, samples, others))
    scatter = np.sqrt(left / max(off.size - 4, 1))
    return Clock(offset, float(scatter / np.sqrt((speed**2).sum()))), left


def _apart(at: np.ndarray, places: np.ndarray, samples: np.ndarray, others: np.ndarray) -> np.ndarray:
    """How far places (n, 3) are from those of samples at times (n,), but for a shift; NaN in gaps."""
    there = np.column_stack([np.interp(at, samples, column) for column in others.T])
    after = np.searchsorted(samples, at).clip(1, len(samples) - 1)
    there[samples[after] - samples[after - 1] > LONGEST] = np.nan
    off = there - places
    return off - off.mean(axis=0)


def _squares(off: np.ndarray) -> float:
    total = float((off**2).sum())
    return total if np.isfinite(total) else np.inf

"""How far a model is off where it was given no load, and whether it may answer alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LIMIT = 0.2e-3
"""How far off a tumour's vertex may be, in 95 of 100 loads, before finite elements behind a model answer [m]."""
LIMITS = (LIMIT, 0.1e-3, 0.05e-3, 0.02e-3, 0.01e-3, 0.0)
"""A model has the widest of these that keeps it within what it may be off by; at the last, nothing is left to it."""
MEAN, WORST = 0.01, 0.2e-3
"""What a model may be off by and still answer alone: mean share of the motion; vertices at 99.9 % [m]."""
FEWEST_FOR_P999 = 1000
"""Fewer loads do not determine the greatest of a thousand."""


@dataclass(frozen=True)
class LeftOut:
    """Errors on cortex left out of the training, of a model alone and with finite elements behind it.

    Parameters
    ----------
    mean, guarded
        Distance over the motion of its load, mean over loads and tumour vertices: alone, and as `Guarded` answers. What
        finite elements answer counts as exact.
    p999
        Of the model alone, over loads and vertices [m]; None of fewer than `FEWEST_FOR_P999` loads.
    solved
        Share of these loads that finite elements answer.
    limit
        Of `LIMITS` [m], at which they do; older files have the first.
    """

    mean: float
    guarded: float
    p999: float | None
    solved: float
    limit: float = LIMIT

    @property
    def enough(self) -> bool:
        """Whether the model may answer alone."""
        return _enough(self.mean, self.p999)

    def __str__(self) -> str:
        """In words."""
        behind = (
            f"with finite elements behind it for {100 * self.solved:.0f} % of the loads, those that it may have over "
            f"{1e3 * self.limit:g} mm off, {100 * self.guarded:.2f} %"
        )
        return f"{100 * self.mean:.2f} % of the motion off alone, {behind}"


@dataclass(frozen=True)
class OffBy:
    """What a model states of its errors on cortex left out of a training: `bound` and `left_out` as in `Learned`."""

    bound: float
    left_out: LeftOut | None

    @property
    def weak(self) -> bool:
        """Whether that is too much to answer alone; where it is not known in the mean, of the worst vertex."""
        return not (self.bound <= LIMIT if self.left_out is None else self.left_out.enough)

    def __str__(self) -> str:
        """In words."""
        if self.left_out is None:
            return f"{1e3 * self.bound:.2g} mm off at most in 95 of 100 loads, where {1e3 * LIMIT:g} mm are enough"
        mean = f"{100 * self.left_out.mean:.2g} % of the motion off in the mean, where {100 * MEAN:g} % are enough"
        if self.left_out.p999 is None:
            return mean
        return f"{mean}; {1e3 * self.left_out.p999:.2g} mm off at 99.9 %, where {1e3 * WORST:g} mm are enough"


def handed_over(bound: np.ndarray, outside: np.ndarray, limit: float) -> np.ndarray:
    """Which loads (B,) bool finite elements answer behind a model: of no bound within the limit, or `outside`.

    `bound` (B,) and `limit` are in metres, `outside` (B,) bool.
    """
    return ~(bound <= limit) | outside


def left_out_of(distance: np.ndarray, motion: np.ndarray, bound: np.ndarray, outside: np.ndarray) -> LeftOut:
    """Errors on B loads; the limit is the widest of `LIMITS` that keeps the guarded model within `MEAN` and `WORST`.

    Parameters
    ----------
    distance
        From the finite elements (B, n) [m], at the tumour's vertices.
    motion
        Mean displacement of these (B,) [m].
    bound
        Of the worst vertex, at 95 % (B,) [m].
    outside
        Which loads (B,) bool lie outside the training range.
    """
    share, left, solved, limit = distance.mean(axis=1) / motion, 0.0, outside, LIMIT
    for limit in LIMITS:
        solved = handed_over(bound, outside, limit)
        left = float(np.where(solved, 0.0, share).mean())
        if _enough(left, _p999(np.where(solved[:, None], 0.0, distance))):
            break
    return LeftOut(float(share.mean()), left, _p999(distance), float(solved.mean()), limit)


def _p999(distance: np.ndarray) -> float | None:
    """Of errors (B, n) [m], if so many loads determine it."""
    return float(np.percentile(distance, 99.9)) if len(distance) >= FEWEST_FOR_P999 else None


def _enough(mean: float, p999: float | None) -> bool:
    return mean <= MEAN and (p999 is None or p999 <= WORST)

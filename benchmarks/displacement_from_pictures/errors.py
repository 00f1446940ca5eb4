"""Errors of answers, and how sure they are: episodes are drawn anew, never frames, as frames of one are alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RESAMPLES = 1000
PERCENTILES = (50.0, 95.0)


@dataclass(frozen=True)
class Figure:
    """A number, and the interval that 95 of 100 resamples lie in."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


@dataclass(frozen=True)
class Errors:
    """Of one way to answer, on one set of frames: median and 95th percentile [mm], and the range of bodies' medians."""

    median: Figure
    p95: Figure
    bodies: tuple[float, float]


def distances(answers: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far off answers (n, 3) are (n,) [mm]."""
    return np.linalg.norm(answers - truth, axis=1)


def errors_of(off: np.ndarray, episode: np.ndarray, body: np.ndarray, seed: int = 0) -> Errors:
    """Errors of answers that are `off` (r, n) [mm] in r runs; figures are means over runs.

    `episode` and `body` (n,) say which frames hang together.
    """
    values = np.percentile(off, PERCENTILES, axis=1).mean(axis=1)
    drawn = resampled(off, episode, seed)
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    median, p95 = (Figure(*map(float, each)) for each in zip(values, low, high, strict=True))
    by_body = [float(np.median(off[:, body == one], axis=1).mean()) for one in np.unique(body)]
    return Errors(median, p95, (min(by_body), max(by_body)))


def resampled(off: np.ndarray, episode: np.ndarray, seed: int = 0, count: int = RESAMPLES) -> np.ndarray:
    """Both percentiles (count, 2), of as many episodes drawn with replacement."""
    random = np.random.default_rng(seed)
    places = [np.flatnonzero(episode == one) for one in np.unique(episode)]
    found = np.empty((count, len(PERCENTILES)))
    for number in range(count):
        chosen = np.concatenate([places[one] for one in random.integers(len(places), size=len(places))])
        found[number] = np.percentile(off[:, chosen], PERCENTILES, axis=1).mean(axis=1)
    return found

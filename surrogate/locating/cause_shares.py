"""Shares of causes in the motion of the cortex, as far as the observation separates the causes.

Shares are computed from posterior samples. Causes with widely scattered shares are not separable. The finest grouping
is chosen in which the joint share of every group is determined.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .causes import KINDS
from .posterior import Posterior
from .prior import MotionPrior

SAMPLE_COUNT = 400  # Number of posterior samples.
TAIL_PROBABILITY = 0.05  # Probability outside a share's interval at each end.
MAX_INTERVAL_WIDTH = 0.5  # Maximum width of the interval of a determined share.
CAUSE_NAMES = {"swelling": "swelling or shrinking"}  # Names of causes whose share may be negative.
MIN_REPORTED_SHARE = 0.005  # Smallest share that is reported.


@dataclass(frozen=True)
class CauseShare:
    """Joint share of causes that cannot be separated from each other.

    Parameters
    ----------
    causes
        Names from `KINDS`; a single name if the cause is separable from all others.
    share, low, high
        Joint share of the mean square motion of the open cortex: mean, and limits of a 90 % interval.
    """

    causes: tuple[str, ...]
    share: float
    low: float
    high: float

    def __str__(self) -> str:
        named = " or ".join(CAUSE_NAMES.get(cause, cause) for cause in self.causes)
        apart = "" if len(self.causes) == 1 else " (not separable)"
        return f"{named}{apart} {100 * self.share:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f} %)"


def group_cause_shares(samples: np.ndarray) -> tuple[CauseShare, ...]:
    """Group `KINDS` as finely as shares (n, kinds) of n samples determine; largest share first, small ones dropped.

    Among several finest groupings, the one with the smallest sum of interval widths is returned.
    """
    ways = []
    for groups in _generate_partitions(range(samples.shape[1])):
        joint = np.stack([samples[:, group].sum(axis=1) for group in groups], axis=1)
        low, high = np.quantile(joint, (TAIL_PROBABILITY, 1.0 - TAIL_PROBABILITY), axis=0)
        if (high - low <= MAX_INTERVAL_WIDTH).all():
            mean = joint.mean(axis=0)
            numbers = np.stack([mean, np.minimum(low, mean), np.maximum(high, mean)], axis=1).tolist()
            names = [tuple(KINDS[kind] for kind in group) for group in groups]
            made = [CauseShare(name, *each) for name, each in zip(names, numbers, strict=True)]
            ways.append((-len(groups), float((high - low).sum()), made))
    *_, best = min(ways, key=lambda way: way[:2])
    return tuple(sorted((each for each in best if each.share > MIN_REPORTED_SHARE), key=lambda each: -each.share))


def _generate_partitions(items: Sequence[int]) -> Iterator[list[list[int]]]:
    """Generate all partitions of some items into groups."""
    if not items:
        yield []
        return
    first, others = items[0], items[1:]
    for count in range(len(others) + 1):
        for some in combinations(others, count):
            for groups in _generate_partitions([item for item in others if item not in some]):
                yield [[first, *some], *groups]


def compute_cause_shares(prior: MotionPrior, posterior: Posterior) -> np.ndarray:
    """Compute shares (n, kinds) of causes in the mean square motion of the open cortex, for n posterior samples."""
    ends = np.round(SAMPLE_COUNT * np.cumsum([result.probability for result in posterior.results])).astype(int)
    normal = np.random.default_rng(0).standard_normal((SAMPLE_COUNT, len(prior.kind)))
    squares, begin = np.zeros((SAMPLE_COUNT, len(KINDS))), 0
    for result, end in zip(posterior.results, ends, strict=True):
        rows = np.flatnonzero(result.rows < len(prior.kind))
        kind = prior.kind[result.rows[rows]]
        weight = result.mean[rows] + normal[begin:end, : len(result.root)] @ result.root[:, rows]
        for number in np.unique(kind):
            own = rows[kind == number]
            shapes = result.rows[own]
            part = weight[:, kind == number]
            squares[begin:end, number] = ((part @ prior.cortex_products[shapes[:, None], shapes]) * part).sum(axis=1)
        begin = end
    return squares / squares.sum(axis=1, keepdims=True)

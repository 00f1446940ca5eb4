"""Which causes moved the cortex, as far as what is seen separates them.

Shares are those of draws from the posterior. Causes whose own shares scatter widely are not separable. Of all ways to
group them, the finest is taken in which the joint share of each group is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .causes import KINDS
from .posterior import Posterior
from .prior import Prior

# Draws; the probability that a share's interval leaves out at either end; and how wide one is of a share that is known.
DRAWS, BEYOND, KNOWN = 400, 0.05, 0.5
# A brain that swells may do so by less than nothing.
WORDS = {"swelling": "swelling or shrinking"}
# A share that is less is not named.
LEAST_NAMED = 0.005


@dataclass(frozen=True)
class CauseShare:
    """What causes that are not separable move together.

    Parameters
    ----------
    causes
        Of `KINDS`; one, where it is separable from all others.
    share, low, high
        Their joint share in what causes move the open cortex by, in mean square: mean, and an interval of 90 %.
    """

    causes: tuple[str, ...]
    share: float
    low: float
    high: float

    def __str__(self) -> str:
        named = " or ".join(WORDS.get(cause, cause) for cause in self.causes)
        apart = "" if len(self.causes) == 1 else " (not separable)"
        return f"{named}{apart} {self.share:.0%} ({self.low:.0%} to {self.high:.0%})"


def cause_shares(drawn: np.ndarray) -> tuple[CauseShare, ...]:
    """Groups of `KINDS` that drawn shares (n, kinds) separate, the largest first, without those of next to nothing.

    Of several finest ways to group them, the one whose intervals are narrowest together.
    """
    ways = []
    for groups in _partitions(range(drawn.shape[1])):
        joint = np.stack([drawn[:, group].sum(axis=1) for group in groups], axis=1)
        low, high = np.quantile(joint, (BEYOND, 1.0 - BEYOND), axis=0)
        if (high - low <= KNOWN).all():
            mean = joint.mean(axis=0)
            numbers = np.stack([mean, np.minimum(low, mean), np.maximum(high, mean)], axis=1).tolist()
            names = [tuple(KINDS[kind] for kind in group) for group in groups]
            made = [CauseShare(name, *each) for name, each in zip(names, numbers, strict=True)]
            ways.append((-len(groups), float((high - low).sum()), made))
    *_, best = min(ways, key=lambda way: way[:2])
    return tuple(sorted((each for each in best if each.share > LEAST_NAMED), key=lambda each: -each.share))


def _partitions(items: Sequence[int]) -> Iterator[list[list[int]]]:
    """Every way to group items."""
    if not items:
        yield []
        return
    first, others = items[0], items[1:]
    for count in range(len(others) + 1):
        for some in combinations(others, count):
            for groups in _partitions([item for item in others if item not in some]):
                yield [[first, *some], *groups]


def drawn_shares(prior: Prior, posterior: Posterior) -> np.ndarray:
    """Shares (n, kinds) of causes in what they move the open cortex by, in mean square, of draws from a posterior."""
    ends = np.round(DRAWS * np.cumsum([answer.share for answer in posterior.answers])).astype(int)
    normal = np.random.default_rng(0).standard_normal((DRAWS, len(prior.kind)))
    squares, begin = np.zeros((DRAWS, len(KINDS))), 0
    for answer, end in zip(posterior.answers, ends, strict=True):
        rows = np.flatnonzero(answer.rows < len(prior.kind))
        kind = prior.kind[answer.rows[rows]]
        weight = answer.mean[rows] + normal[begin:end, : len(answer.root)] @ answer.root[:, rows]
        for number in np.unique(kind):
            own = rows[kind == number]
            shapes = answer.rows[own]
            part = weight[:, kind == number]
            squares[begin:end, number] = ((part @ prior.on_cortex[shapes[:, None], shapes]) * part).sum(axis=1)
        begin = end
    return squares / squares.sum(axis=1, keepdims=True)

"""The Gaussian that is left of a prior on motions, once some of them are seen.

A prior motion is a sum of shapes with independent weights (Rasmussen, Williams 2006, "Gaussian Processes for Machine
Learning", section 2.1). What takes part is a hypothesis; hypotheses are weighed by their evidence (equation 5.8).
Shapes only resemble tissue, so that evidence counts less than its formula says: Miller, Dunson 2019, "Robust Bayesian
inference via coarsening", J. Am. Stat. Assoc. 114:1113-1125. Leaving points out: Sundararajan, Keerthi 2001,
"Predictive approaches for choosing hyperparameters in Gaussian processes", Neural Comput. 13:1103-1118.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import chdtri

from .evidence import Evidence, Whitening
from .prior import Hypothesis, Prior

# A point is taken for an outlier if a better one is so improbable; so few points are not tested against each other.
IMPROBABLE, FEWEST = 1e-4, 4
NO_TIPS = np.zeros((0, 3))
# Evidence counts as one part in so many: hypotheses are seldom as wrong as they look.
COARSENED = 2.0
# So many of the most probable hypotheses make a mixture.
MIXED = 24


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known after seeing.

    Parameters
    ----------
    evidence
        What it was conditioned on: without outliers.
    weight, spread
        Mean (r,) and covariance (r, r) of the shapes' weights.
    rigid, rigid_spread
        The same of the rigid error (6,), (6, 6): translation [m], rotation [rad].
    surprise
        Mean over points of how improbable each is by all others, as a share of what is expected: 1 where all fits.
    outliers
        Numbers of the points that were left out.
    """

    evidence: Evidence
    weight: np.ndarray
    spread: np.ndarray
    rigid: np.ndarray
    rigid_spread: np.ndarray
    surprise: float
    outliers: np.ndarray

    def bias_at(self, places: np.ndarray) -> np.ndarray:
        """The mean rigid error (n, 3) [m] at places (n, 3) [m]."""
        return self.rigid[:3] + np.cross(self.rigid[3:], places - self.evidence.middle)

    @property
    def rows(self) -> np.ndarray:
        """(k,) of the shapes that take part."""
        return np.flatnonzero(np.diagonal(self.spread) > 0.0)


@dataclass(frozen=True, eq=False)
class Answer:
    """What one hypothesis says: share, its probability; rows (k,) of the unknowns, mean (k,), and back (k, k).

    The covariance is back^T back.
    """

    share: float
    rows: np.ndarray
    mean: np.ndarray
    back: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenPrior:
    """A prior as it is seen at some points, whitened by their errors.

    Parameters
    ----------
    prior
        What is believed.
    scale
        Size that motions may have [mm], in root mean square.
    whitening
        What its errors were made independent by.
    unknown
        (m, r + 6): what unit weights and a rigid error of one standard deviation do, whitened.
    value
        (m,): what is seen, whitened.
    odds
        As `Prior.odds`.
    """

    prior: Prior
    scale: float
    whitening: Whitening
    unknown: np.ndarray
    value: np.ndarray
    odds: np.ndarray

    @cached_property
    def pull(self) -> np.ndarray:
        """(r + 6,): products of the unknowns with what is seen."""
        return self.value @ self.unknown

    def answers(self) -> list[Answer]:
        """Of the most probable hypotheses; their shares sum to 1."""
        found = [
            (log, hypothesis, hypothesis.places[number - 1] if number else hypothesis.places[:0].ravel())
            for hypothesis in self.prior.hypotheses
            for number, log in enumerate(self.weighed(hypothesis))
        ]
        found = sorted(found, key=lambda each: -each[0])[:MIXED]
        share = np.exp([log - found[0][0] for log, _, _ in found])
        share /= share.sum()
        return [self.answer(some, place, float(own)) for own, (_, some, place) in zip(share, found, strict=True)]

    @cached_property
    def gram(self) -> np.ndarray:
        """(r + 6, r + 6): products of the unknowns with each other."""
        return self.unknown.T @ self.unknown

    def weighed(self, hypothesis: Hypothesis) -> np.ndarray:
        """Logarithms of odds and coarsened evidence (1 + p,): no tool, one on each place; less what all share."""
        own, size = self._base(hypothesis)
        lower = self._lower(own, size)
        half = solve_triangular(lower, size * self.pull[own], lower=True, check_finite=False)
        alone = 0.5 * half @ half - np.log(np.diagonal(lower)).sum()
        # Each place's shapes are bordered to the matrix that all have in common: its Schur complement is small.
        table = hypothesis.places
        across = self.scale * size[:, None] * self.gram[np.ix_(own, table.ravel())]
        across = solve_triangular(lower, across, lower=True, check_finite=False)
        rest = (self.scale * self.pull[table.ravel()] - across.T @ half).reshape(table.shape)
        apart = across.reshape(len(own), *table.shape).transpose(1, 2, 0)
        blocks = self.scale**2 * self.gram[table[:, :, None], table[:, None]]
        schur = np.eye(table.shape[1]) + blocks - apart @ apart.transpose(0, 2, 1)
        gain = np.einsum("pi,pi->p", rest, np.linalg.solve(schur, rest[..., None])[..., 0])
        own_odds = self.odds[: 1 + len(table)]
        pressed = alone + 0.5 * (gain - np.linalg.slogdet(schur)[1])
        return own_odds + np.append(alone, pressed) / COARSENED

    def answer(self, hypothesis: Hypothesis, place: np.ndarray, share: float) -> Answer:
        """What a hypothesis says with some more rows (q,), those of one place."""
        own, size = self._base(hypothesis)
        own, size = np.append(own, place), np.append(size, np.full(len(place), self.scale))
        back = solve_triangular(self._lower(own, size), np.diag(size), lower=True, check_finite=False)
        return Answer(share, own, back.T @ (back @ self.pull[own]), back)

    def _lower(self, own: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Cholesky factor of the precision of some unknowns, each over its prior standard deviation."""
        inner = size[:, None] * self.gram[np.ix_(own, own)] * size
        return cholesky(np.eye(len(own)) + inner, lower=True, check_finite=False)

    def _base(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """Rows and standard deviations of its unknowns, the rigid error's last."""
        rigid = np.arange(len(self.pull) - 6, len(self.pull))
        size = np.append(self.scale * hypothesis.size, np.full(6, hypothesis.rigid))
        return np.append(hypothesis.rows, rigid), size


def seen_prior(prior: Prior, evidence: Evidence, tips: np.ndarray = NO_TIPS) -> SeenPrior:
    """How a prior is seen by some evidence, where tips of tools (k, 3) [m] touch the cortex."""
    seen = float(np.sqrt((evidence.value**2).sum() / len(np.unique(evidence.point))))
    whitening = evidence.whitening(seen)
    unknown = np.concatenate([prior.seen(evidence.place, evidence.axis), evidence.rigid * evidence.rigid_scale], axis=1)
    # A motion and a rigid error may cancel, so that little is seen of either.
    scale = 1e3 * float(np.hypot(seen, np.sqrt(3.0) * evidence.shift))
    return SeenPrior(
        prior, scale, whitening, whitening.white(unknown), whitening.white(evidence.value), prior.odds(tips)
    )


def conditioned(prior: Prior, evidence: Evidence, tips: np.ndarray = NO_TIPS) -> Posterior:
    """Condition a prior on evidence, without points that no other supports. Tips (k, 3) [m] touch the cortex."""
    kept, point = np.ones(len(evidence), bool), evidence.point
    while True:
        some = evidence.rows(kept)
        seen = seen_prior(prior, some, tips)
        answers = seen.answers()
        odd = _oddness(seen, max(answers, key=lambda answer: answer.share), some.point)
        excess = odd / chdtri(np.unique(some.point, return_counts=True)[1], IMPROBABLE)
        if excess.max() <= 1.0 or len(excess) <= FEWEST:
            break
        kept &= ~np.isin(point, np.unique(some.point)[excess >= max(1.0, 0.5 * excess.max())])
    means, share = np.zeros((len(answers), len(seen.pull))), np.array([answer.share for answer in answers])
    for row, answer in zip(means, answers, strict=True):
        row[answer.rows] = answer.mean
    mean = share @ means
    spread = (share * (means - mean).T) @ (means - mean)
    for answer in answers:
        spread[np.ix_(answer.rows, answer.rows)] += answer.share * answer.back.T @ answer.back
    scale = evidence.rigid_scale
    return Posterior(
        some, mean[:-6], spread[:-6, :-6], scale * mean[-6:], np.outer(scale, scale) * spread[-6:, -6:],
        float(odd.sum() / len(some)), np.setdiff1d(point, some.point),
    )  # fmt: skip


def _oddness(seen: SeenPrior, answer: Answer, point: np.ndarray) -> np.ndarray:
    """Square Mahalanobis distance of each point (n,) from what all others predict of it, by one hypothesis."""
    root = seen.unknown[:, answer.rows] @ answer.back.T
    gain = seen.whitening.back(seen.value - root @ (root.T @ seen.value))
    known, number = seen.whitening.back(root), np.unique(point, return_inverse=True)[1]
    order, count = np.argsort(number, kind="stable"), np.bincount(number)
    found, first = np.empty(len(count)), np.cumsum(count) - count
    for size in np.unique(count):
        some = np.flatnonzero(count == size)
        table = order[first[some][:, None] + np.arange(size)]
        inverse = seen.whitening.precision(table) - known[table] @ known[table].transpose(0, 2, 1)
        own = gain[table]
        found[some] = np.einsum("ni,ni->n", own, np.linalg.solve(inverse, own[..., None])[..., 0])
    return found


def scaled(posterior: Posterior, factor: float) -> Posterior:
    """The same, with covariances times a factor."""
    return replace(posterior, spread=factor * posterior.spread, rigid_spread=factor * posterior.rigid_spread)

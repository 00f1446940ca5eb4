"""How far a prediction may be from the finite elements: split conformal bounds with a scale for each load.

Lei, G'Sell, Rinaldo, Tibshirani, Wasserman 2018, "Distribution-free predictive inference for regression", J. Am. Stat.
Assoc. 113:1094-1111, section 5.2. The quantiles are by classes as in Vovk, Lindsay, Nouretdinov, Gammerman 2003,
"Mondrian confidence machine". Every class of force has quantiles of its own, so that weak loads do not vouch for strong
ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..array_functions import taken
from ..data.indentation import relaxed_of
from ..regressors.protocol import standardisation
from .training_range import Measured, Outside

LEVELS = (0.95, 0.99)
# So many calibration loads make a class of force, of which there are at most so many.
CLASS, CLASSES = 200, 10
# Of the squared weights, beside the squared misfit of logarithms of unit variance a load.
RIDGE = 1e-2
# The first features describe the load: force, radius, angle, overhang. The rest are its place.
LOAD = 4
# Fewer errors than ten a term determine no curvature.
BENDS = 150
# Standard deviations beyond which a feature counts no further; and the share of the mean below which no error counts.
FARTHEST, LEAST = 4.0, 1e-3
# How much a bound grows beyond the range of training loads, for each unit of `Outside.beyond`. With the distance from
# the nearest training load it grows by so much [1/m] where no loads tell how much, and never by more than the last.
GROWTH, USUAL_GROWTH, MOST_GROWTH = 4.0, 1e3, 2e4


@dataclass(frozen=True, eq=False)
class Bound:
    """With probability 0.95 (0.99) the largest error over the tumour's vertices is below quantile x scale(load).

    Promised for loads drawn as the calibration loads were; elsewhere it grows, and promises nothing.

    Parameters
    ----------
    mean, deviation
        (f,) of the scale's features.
    weights
        (t,) of the monomials up to the second degree of standardised features; their sum is the logarithm of the scale.
    edges
        (k - 1,) forces [N] between the k classes.
    quantile
        (2, k): of error over scale, for `LEVELS` and each class.
    growth, near
        () [1/m], with the distance from the nearest training load, of which the first part () [m] does not count.
    """

    mean: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    edges: np.ndarray
    quantile: np.ndarray
    growth: np.ndarray
    near: np.ndarray

    def of(self, features: np.ndarray, force: np.ndarray, outside: Outside) -> np.ndarray:
        """Bounds (2, B) [m] for `LEVELS`, of features (B, f), forces (B,) [N], and where the B loads lie."""
        scale = np.exp(_monomials(_standard(features, self.mean, self.deviation)) @ self.weights)
        away = np.maximum(outside.away - self.near, 0.0)
        scale = scale * (1.0 + self.growth * away) * (1.0 + GROWTH * outside.beyond)
        return taken(np.searchsorted(self.edges, force), self.quantile.T).T * scale


def fitted_bound(
    seen: tuple[np.ndarray, np.ndarray],
    features: np.ndarray,
    force: np.ndarray,
    error: np.ndarray,
    each: int = CLASS,
    *,
    curved: bool = True,
    away: np.ndarray | float = 0.0,
    growth: float = 0.0,
) -> Bound:
    """A bound whose scale follows what was `seen`, calibrated on other loads.

    The scale depends on the load, not on its place. Where `seen` loads lie in few discs of the cortex, a scale that
    follows the place runs away between them. One that did bounded a distance that was 0.05 mm off by 4.2 mm.

    Parameters
    ----------
    seen
        Features (m, f) and largest errors (m,) [m] of loads that are not of the model's training.
    features, force, error
        (n, f), (n,) [N] and largest errors (n,) [m], of the calibration loads.
    each
        Calibration loads of a class of force, at least: fewer than 99 promise nothing at 0.99.
    curved
        Whether the scale's logarithm is quadratic in the load's features, if `BENDS` loads were seen, or linear.
    away, growth
        (n,) [m] of the calibration loads from the nearest training load, and how much the bound grows with that [1/m].
    """
    mean, deviation = standardisation(seen[0])
    used = _used(len(mean), LOAD if curved and len(seen[1]) >= BENDS else 0)
    design = _monomials(_standard(seen[0], mean, deviation))[:, used]
    wanted = np.log(np.maximum(seen[1], max(LEAST * seen[1].mean(), np.finfo(float).tiny)))
    penalty = RIDGE * len(design) * np.eye(design.shape[1])
    penalty[0, 0] = 0.0  # the constant is free
    weights = np.zeros(len(used))
    weights[used] = np.linalg.solve(design.T @ design + penalty, design.T @ wanted)
    scale = np.exp(_monomials(_standard(features, mean, deviation)) @ weights)
    ratio = error / (scale * (1.0 + growth * away))
    count = int(np.clip(len(ratio) // each, 1, CLASSES))
    edges = np.unique(np.quantile(force, np.arange(1, count) / count))
    edges = edges[edges < force.max()]  # equal forces are of one class
    count, member = len(edges) + 1, np.searchsorted(edges, force)
    quantile = np.array([[conformal(ratio[member == k], level) for k in range(count)] for level in LEVELS])
    return Bound(mean, deviation, weights, edges, quantile, np.array(growth), np.zeros(()))


def fitted_growth(near: tuple[np.ndarray, np.ndarray], far: tuple[np.ndarray, np.ndarray]) -> float:
    """The growth [1/m] by which the first of `LEVELS` is met as well far from training loads as near them.

    Parameters
    ----------
    near, far
        Errors over a bound that does not grow (n,), and distances (n,) [m] from the nearest training load: of loads
        drawn as the training loads, and of others. Fewer than 19 of these tell nothing: `USUAL_GROWTH`.
    """

    def larger(growth: float) -> bool:
        asked, promised = (conformal(ratio / (1.0 + growth * away), LEVELS[0]) for ratio, away in (far, near))
        return asked > promised

    if not np.isfinite(conformal(far[0], LEVELS[0])):
        return USUAL_GROWTH
    least, most = 0.0, MOST_GROWTH
    for _ in range(40):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if larger(middle) else (least, middle)
    return most


def features_of(pushed: Pushed, known: Measured) -> np.ndarray:
    """The features of an error's size (B, 7): logarithms of force and radius, angle, overhang and point [mm].

    Of tissue that relaxes, where all loads have one tool, the share that is gone stands for the radius.
    """
    force, relaxed = np.log(np.maximum(known.magnitude, np.finfo(float).tiny)), relaxed_of(pushed)
    second = np.log(pushed.footprint) if relaxed is None else relaxed
    return np.column_stack([force, second, known.angle, 1e3 * known.overhang, 1e3 * pushed.point])


def conformal(ratio: np.ndarray, level: float) -> float:
    """The ceil(level (n + 1))-th smallest of `ratio` (n,): infinite, where n is too small for the level."""
    rank = int(np.ceil(level * (len(ratio) + 1)))
    return float(np.sort(ratio)[rank - 1]) if rank <= len(ratio) else np.inf


def _standard(features: np.ndarray, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    return np.clip((features - mean) / deviation, -FARTHEST, FARTHEST)


def _monomials(x: np.ndarray) -> np.ndarray:
    """1, x_i and x_i x_j of (B, f): (B, t)."""
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones_like(x[:, :1]), x, x[:, first] * x[:, second]], axis=1)


def _used(count: int, curved: int) -> np.ndarray:
    """Which monomials (t,) bool are fitted: 1, x_i of the load, and x_i x_j of the first `curved` features."""
    return np.concatenate([[True], np.arange(count) < LOAD, np.triu_indices(count)[1] < curved])

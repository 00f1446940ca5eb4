"""Bounds on the error of a prediction relative to FEM: split conformal prediction with a load-dependent scale.

Lei, G'Sell, Rinaldo, Tibshirani, Wasserman 2018, "Distribution-free predictive inference for regression", J. Am. Stat.
Assoc. 113:1094-1111, section 5.2. Loads are divided into classes of force, each with its own quantiles, as in Vovk,
Lindsay, Nouretdinov, Gammerman 2003, "Mondrian confidence machine". The errors of weak loads thus do not determine the
bounds of strong loads.
"""

from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..array_functions import take_rows
from ..data.indentation import get_relaxation
from ..regressors.protocol import compute_standardisation
from .training_range import Excess, LoadMeasures

LEVELS = (0.95, 0.99)  # Nominal coverage of the bounds.
LOAD_FEATURES = 4  # Number of features before the load's position: force, radius, angle, overhang.
FEATURE_LIMIT = 4.0  # Limit of standardised features [standard deviations].
GROWTH = 4.0  # Relative growth of a bound beyond the training range, per unit of `Excess.bound_excess`.
# Default growth with the distance from the nearest training load, where no loads determine it [1/m].
USUAL_GROWTH = 1e3
MAX_GROWTH = 2e4  # Maximum growth with the distance from the nearest training load [1/m].


@dataclass(frozen=True)
class BoundSettings:
    """Settings of `fit_bound`."""

    # Minimum number of calibration loads in a force class; fewer than 99 give no guarantee at 0.99.
    loads_per_class: int = 200
    # If True, the scale's logarithm is quadratic in the load's features, given `min_quadratic_errors`; else linear.
    allow_quadratic: bool = True
    max_classes: int = 10  # Maximum number of classes of force.
    # Weight of the squared coefficients relative to the squared misfit of logarithms, per load.
    ridge_weight: float = 1e-2
    min_quadratic_errors: int = 150  # Minimum number of scale examples for a quadratic scale: ten per term.
    min_error_share: float = 1e-3  # Lower limit of an error when its logarithm is fitted, as a share of the mean error.


@dataclass(frozen=True, eq=False)
class Bound:
    """Bound on the maximum error over the tumour's vertices, with probability 0.95 and 0.99: quantile x scale(load).

    It is guaranteed for loads with the distribution of the calibration loads. Elsewhere it grows, without a guarantee.

    Parameters
    ----------
    mean, deviation
        Mean and standard deviation (f,) of the scale's features.
    weights
        Weights (t,) of the monomials (degree <= 2) of standardised features; the weighted sum is the scale's logarithm.
    edges
        Limits (k - 1,) [N] between the k classes of force.
    quantile
        Quantiles (2, k) of error / scale, for each of `LEVELS` and each class of force.
    growth, near
        Growth () [1/m] with the distance from the nearest training load, and distance () [m] beyond which it applies.
    """

    mean: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    edges: np.ndarray
    quantile: np.ndarray
    growth: np.ndarray
    near: np.ndarray

    def evaluate(self, features: np.ndarray, force: np.ndarray, range_excess: Excess) -> np.ndarray:
        """Compute bounds (2, B) [m] for `LEVELS`, from features (B, f), forces (B,) [N] and `range_excess`."""
        scale = np.exp(_compute_monomials(_normalise_features(features, self.mean, self.deviation)) @ self.weights)
        away = np.maximum(range_excess.distance - self.near, 0.0)
        scale = scale * (1.0 + self.growth * away) * (1.0 + GROWTH * range_excess.bound_excess)
        return take_rows(np.searchsorted(self.edges, force), self.quantile.T).T * scale


def fit_bound(
    scale_examples: tuple[np.ndarray, np.ndarray], features: np.ndarray, force: np.ndarray, error: np.ndarray,
    settings: BoundSettings = BoundSettings(), *, distance: np.ndarray | float = 0.0, growth: float = 0.0,
) -> Bound:  # fmt: skip
    """Fit the scale of a bound to the errors of `scale_examples`, and calibrate its quantiles on other loads.

    The fitted scale does not depend on the load's position. If `scale_examples` cover little of the cortex, a scale
    that depends on position diverges between them. One such scale gave a bound of 4.2 mm for a distance with an error
    of 0.05 mm.

    Parameters
    ----------
    scale_examples
        Features (m, f) and maximum errors (m,) [m] of loads that the model was not trained on.
    features, force, error
        Features (n, f), forces (n,) [N] and maximum errors (n,) [m] of the calibration loads.
    distance, growth
        Distances (n,) [m] of the calibration loads from the nearest training load; growth of the bound with it [1/m].
    """
    mean, deviation = compute_standardisation(scale_examples[0])
    curved = settings.allow_quadratic and len(scale_examples[1]) >= settings.min_quadratic_errors
    used = _mask_monomials(len(mean), LOAD_FEATURES if curved else 0)
    design = _compute_monomials(_normalise_features(scale_examples[0], mean, deviation))[:, used]
    wanted = np.log(
        np.maximum(scale_examples[1], max(settings.min_error_share * scale_examples[1].mean(), np.finfo(float).tiny))
    )
    penalty = settings.ridge_weight * len(design) * np.eye(design.shape[1])
    penalty[0, 0] = 0.0  # the constant is free
    weights = np.zeros(len(used))
    weights[used] = np.linalg.solve(design.T @ design + penalty, design.T @ wanted)
    scale = np.exp(_compute_monomials(_normalise_features(features, mean, deviation)) @ weights)
    ratio = error / (scale * (1.0 + growth * distance))
    count = int(np.clip(len(ratio) // settings.loads_per_class, 1, settings.max_classes))
    edges = np.unique(np.quantile(force, np.arange(1, count) / count))
    edges = edges[edges < force.max()]  # equal forces are of one class
    count, member = len(edges) + 1, np.searchsorted(edges, force)
    quantile = np.array(
        [[compute_conformal_quantile(ratio[member == k], level) for k in range(count)] for level in LEVELS]
    )
    return Bound(mean, deviation, weights, edges, quantile, np.array(growth), np.zeros(()))


def fit_growth(near: tuple[np.ndarray, np.ndarray], far: tuple[np.ndarray, np.ndarray]) -> float:
    """Compute the growth [1/m] with which a bound has the same coverage far from the training loads as near them.

    Parameters
    ----------
    near, far
        Ratios (n,) of error to a bound without growth, and distances (n,) [m] from the nearest training load.
        `near`: loads sampled as those. `far`: others; with fewer than 19, `USUAL_GROWTH` is returned.
    """

    def is_too_small(growth: float) -> bool:
        asked, promised = (
            compute_conformal_quantile(ratio / (1.0 + growth * away), LEVELS[0]) for ratio, away in (far, near)
        )
        return asked > promised

    if not np.isfinite(compute_conformal_quantile(far[0], LEVELS[0])):
        return USUAL_GROWTH
    least, most = 0.0, MAX_GROWTH
    for _ in range(40):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if is_too_small(middle) else (least, middle)
    return most


def compute_scale_features(pushes: Pushed, measures: LoadMeasures) -> np.ndarray:
    """Compute the features (B, 7) of a bound's scale: logarithms of force and radius, angle, overhang, point [mm].

    For relaxing tissue, where all loads have the same tool, the relaxed share replaces the radius.
    """
    force, relaxed = np.log(np.maximum(measures.magnitude, np.finfo(float).tiny)), get_relaxation(pushes)
    second = np.log(pushes.footprint) if relaxed is None else relaxed
    return np.column_stack([force, second, measures.angle, 1e3 * measures.overhang, 1e3 * pushes.point])


def compute_conformal_quantile(ratio: np.ndarray, level: float) -> float:
    """Return the ceil(level (n + 1))-th smallest of `ratio` (n,); infinity if n is too small for `level`."""
    rank = int(np.ceil(level * (len(ratio) + 1)))
    return float(np.sort(ratio)[rank - 1]) if rank <= len(ratio) else np.inf


def _normalise_features(features: np.ndarray, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    return np.clip((features - mean) / deviation, -FEATURE_LIMIT, FEATURE_LIMIT)


def _compute_monomials(x: np.ndarray) -> np.ndarray:
    """Compute the monomials 1, x_i and x_i x_j (B, t) of `x` (B, f)."""
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones_like(x[:, :1]), x, x[:, first] * x[:, second]], axis=1)


def _mask_monomials(count: int, quadratic: int) -> np.ndarray:
    """Return the mask (t,) of the monomials to fit: 1, x_i of the load, and x_i x_j of `quadratic` features."""
    return np.concatenate([[True], np.arange(count) < LOAD_FEATURES, np.triu_indices(count)[1] < quadratic])

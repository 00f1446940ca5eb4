"""Calibration of covariances by trials on ensemble members whose group is not in the trial's prior."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.geometry.locate import LocatedPoints

from .causes import DRAINAGE, OEDEMA, SWELLING, TOOL, PressResponses
from .ensemble import Ensemble, compute_surface_motion
from .evidence import SIGMA, Evidence, build_motion_evidence
from .iterated_conditioning import match_and_update
from .observation import Observation
from .posterior import Posterior
from .prior import MotionPrior, build_prior, compute_centroid_motion

LEVEL = 0.95
"""Nominal coverage of ellipsoids."""
RADIUS_SQUARED = float(2.0 * gammaincinv(1.5, LEVEL))
"""Squared radius of the 95 % ellipsoid of a 3D Gaussian [standard deviations^2]: chi-squared quantile."""
TRIAL_COUNT = 960  # Number of trials.
NEAREST_TRIALS = (
    120  # Number of trials, nearest by `compute_similarity_features`, that calibrate an observation's covariance.
)
CLOUD_OFFSET = 1e3  # Feature offset that separates point clouds from corresponding points [log units].
EXTENT_WEIGHT = 4.0  # Weight of the extent feature.
# Tolerance beyond the largest trial features [log units], so that 400 points, the maximum used, are covered.
FEATURE_TOLERANCE = 0.05
SINGLE_CAUSES = (TOOL, DRAINAGE, SWELLING, OEDEMA)  # Causes that move the brain in a trial.
MIN_MOTION_RATIO = 1e-3  # Lower bound of motion over error, so that its logarithm is finite.


@dataclass(frozen=True)
class TrialSettings:
    """Settings of the trials in `run_trials`."""

    point_counts: tuple[int, int] = (20, 400)  # Range of a trial's number of points.
    covered_shares: tuple[float, float] = (0.1, 1.0)  # Range of a trial's observed share of the open cortex.
    # Range of a trial's tissue compliance relative to the ensemble.
    compliance_ratios: tuple[float, float] = (0.7, 2.0)
    error_ratios: tuple[float, float] = (0.05, 1.0)  # Range of a trial's point errors relative to `SIGMA`.
    shift_range: tuple[float, float] = (0.05e-3, 3e-3)  # Range of a trial's rigid error along each axis [m].
    no_shift_probability: float = 0.25  # Probability of no rigid error in a trial.
    min_motion: float = 0.5e-3  # Minimum RMS motion of the open cortex for a member to be used in a trial [m].


def run_trials(
    ensemble: Ensemble, presses: PressResponses, progress: Callable[[int, int], object] = lambda done, total: None,
    count: int = TRIAL_COUNT, settings: TrialSettings = TrialSettings(),
) -> np.ndarray:  # fmt: skip
    """Run `count` trials; return their features (`compute_similarity_features`) and squared Mahalanobis errors (k, 5).

    One group per skull is held out at a time, so that a trial's tissue, tumour and directions are not in its prior. One
    motion in three combines two causes. Rigid errors have exactly the reported size, from 0 to 3 mm. Half of the trials
    use point clouds (no correspondences). Rejected observations are skipped. No trial has a tool tip, which would make
    errors smaller.

    Raises
    ------
    InputError
        No skull has two groups, of which one can be held out.
    """
    fold, found = assign_folds(ensemble), []
    if fold.max() < 0:
        raise InputError("no skull has two groups to try one by the other: give causes of several Poisson's ratios.")
    large = compute_surface_motion(ensemble.anatomy, ensemble.motion) > settings.min_motion
    for turn, numbers in enumerate(np.array_split(np.arange(count), fold.max() + 1)):
        prior, members = build_prior(ensemble, presses, fold != turn), np.flatnonzero((fold == turn) & large)
        for number in numbers:
            random = np.random.default_rng(number)
            observation, middle = _simulate_trial(ensemble, members, int(number), random, settings)
            progress(int(number), count)
            try:
                posterior, _ = match_and_update(prior, observation)
            except InputError:
                continue
            found.append([*compute_similarity_features(posterior.evidence), _square_distance(prior, posterior, middle)])
    progress(count, count)
    return np.array(found)


def assign_folds(ensemble: Ensemble) -> np.ndarray:
    """Return the fold (N,) in which a member is held out, one group per skull; -1 for the only group of a skull."""
    turn = np.full(len(ensemble.group), -1)
    for skull in np.unique(ensemble.skull):
        own = ensemble.skull == skull
        numbers, place = np.unique(ensemble.group[own], return_inverse=True)
        if len(numbers) > 1:
            turn[own] = place
    return turn


def compute_coverage_factor(trials: np.ndarray, evidence: Evidence) -> float:
    """Compute the factor on covariances with which tumour-centroid ellipsoids cover 95 % of similar trials."""
    away = ((trials[:, :-1] - compute_similarity_features(evidence)) ** 2).sum(axis=1)
    square = np.sort(trials[np.argsort(away, kind="stable")[:NEAREST_TRIALS], -1])
    rank = min(int(np.ceil(LEVEL * (len(square) + 1))), len(square))
    return float(square[rank - 1] / RADIUS_SQUARED)


def is_within_trials(trials: np.ndarray, evidence: Evidence) -> bool:
    """Return True if the features of the evidence are in the range of the trials; the extent has no upper limit."""
    own = compute_similarity_features(evidence)
    alike = trials[trials[:, -2] == own[-1], :-1]
    within = len(alike) and (own >= alike.min(axis=0)).all()
    return bool(within and (own[[0, 1, 3]] <= alike[:, [0, 1, 3]].max(axis=0) + FEATURE_TOLERANCE).all())


def compute_similarity_features(evidence: Evidence) -> np.ndarray:
    """Compute the features (4,) that measure similarity of trials: three logarithms, and `CLOUD_OFFSET` for clouds.

    The logarithms are those of the observed motion / its error (rigid error included), of the number of points, and of
    the observed patch's extent: root mean square distance [m] from its centroid, times `EXTENT_WEIGHT`. The fourth is 0
    for points with correspondences.
    """
    first = np.unique(evidence.point, return_index=True)[1]
    count, at = len(first), evidence.positions[first]
    seen = np.sqrt((evidence.motion**2).sum() / count)
    ratio = max(seen / np.hypot(np.median(evidence.sigma), evidence.shift_sigma), MIN_MOTION_RATIO)
    extent = np.sqrt(((at - at.mean(axis=0)) ** 2).sum(axis=1).mean())
    logs = np.log([ratio, count, extent]) * [1.0, 1.0, EXTENT_WEIGHT]
    return np.append(logs, CLOUD_OFFSET * (not evidence.is_paired))


def _simulate_trial(
    ensemble: Ensemble, members: np.ndarray, number: int, rng: np.random.Generator, settings: TrialSettings
) -> tuple[Observation, np.ndarray]:
    """Simulate an observation of one or two motions; return it and the tumour centroid's true motion (3,) [m]."""
    anatomy = ensemble.anatomy
    here = members[ensemble.skull[members] == rng.choice(np.unique(ensemble.skull[members]))]
    several = np.intersect1d(SINGLE_CAUSES, ensemble.kind[here])
    causes = rng.permutation(several)[: 1 + (number % 3 == 0)]
    chosen = [rng.choice(here[ensemble.kind[here] == cause]) for cause in causes]
    softer = np.exp(rng.uniform(*np.log(settings.compliance_ratios)))
    motion = softer * ensemble.motion[chosen].sum(axis=0, dtype=float)
    count = int(np.exp(rng.uniform(*np.log(settings.point_counts))))
    evidence = sample_observed_patch(anatomy, motion, rng, count, rng.uniform(*settings.covered_shares))
    sigma = np.full(len(evidence), SIGMA * np.exp(rng.uniform(*np.log(settings.error_ratios))))
    has_shift = rng.uniform() >= settings.no_shift_probability
    shift = float(np.exp(rng.uniform(*np.log(settings.shift_range)))) if has_shift else 0.0
    evidence = replace(evidence, sigma=sigma, shift_sigma=shift)
    off = np.linalg.cholesky(evidence.compute_covariance()) @ rng.standard_normal(len(evidence))
    way = rng.standard_normal((2, 3))
    way *= np.sqrt(3.0) / np.linalg.norm(way, axis=1, keepdims=True)
    shifted, turned = evidence.rigid_scale.reshape(2, 3) * way
    rest = evidence.positions[::3]
    now = rest + (evidence.motion + off).reshape(-1, 3) + shifted + np.cross(turned, rest - evidence.centroid)
    observation = Observation(now, rest if number % 2 else None, sigma[::3], rigid=shift)
    return observation, compute_centroid_motion(anatomy, motion[None])[0]


def sample_observed_patch(
    anatomy: Anatomy, motion: np.ndarray, rng: np.random.Generator, count: int, area_share: float
) -> Evidence:
    """Sample `count` points, without errors, of a motion (V, 3) [m] on a round `area_share` of the open cortex."""
    nodes, triangles = anatomy.mesh.nodes, anatomy.open_surface
    corners = nodes[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middles = corners.mean(axis=1)
    order = np.argsort(((middles - middles[rng.choice(len(area), p=area / area.sum())]) ** 2).sum(axis=1))
    within = np.cumsum(area[order]) <= area_share * area.sum()
    some = order[: max(4, np.count_nonzero(within))]
    triangle = rng.choice(some, count, p=area[some] / area[some].sum())
    weights = rng.dirichlet(np.ones(3), count)
    vertices = triangles[triangle]
    at, moved = (np.einsum("nc,nci->ni", weights, field[vertices]) for field in (nodes, motion))
    place = LocatedPoints(np.column_stack([vertices, vertices[:, 0]]), np.column_stack([weights, np.zeros(count)]))
    return build_motion_evidence(place, at, moved, np.full(count, SIGMA))


def _square_distance(prior: MotionPrior, posterior: Posterior, centroid_motion: np.ndarray) -> float:
    """Return the squared Mahalanobis distance between the estimated and the true `centroid_motion` (3,) [m]."""
    off = posterior.shape_weights @ prior.centroid_motion - centroid_motion
    return float(off @ np.linalg.solve(posterior.compute_covariance(prior.centroid_motion[:, None])[0], off))

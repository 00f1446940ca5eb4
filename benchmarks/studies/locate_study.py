"""Synthetic test cases: error and coverage of estimates of a tumour's known motion from cortex points."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.analysis.measurement import time_work
from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.runtime.threads import limit_to_one_thread
from surrogate.locating.calibration import RADIUS_SQUARED, sample_observed_patch
from surrogate.locating.evidence import compute_correlation_root
from surrogate.locating.locator import Locator
from surrogate.locating.observation import Observation
from surrogate.locating.prior import compute_centroid_motion

from .locate_rivals import Rival, fit_oracle
from .locate_twins import SyntheticCase

OURS, ORACLE = "sulcus locate", "best sum of its shapes"
"""Names of the locator, and of the best estimate by its shapes, which uses the true motion."""
# Reported standard deviation of points without error [m], since a locator requires one.
EXACT = 5e-5
# Errors of points: independent and correlated [m], correlation length [m], angle of the rigid error [rad].
WHITE, SMOOTH, LENGTH, TURN = 0.3e-3, 0.5e-3, 15e-3, float(np.radians(0.5))
TRANSLATIONS = (0.0, 1e-3, 2e-3)
"""Translation of the rigid error at each level of noise [m]; level 0 has no error of any kind."""
# Range of a wrong registration's error: a translation [m], or a rotation [rad] about the brain's centre.
WRONG_BY = (2e-3, 5e-3), (float(np.radians(2.0)), float(np.radians(4.0)))


@dataclass(frozen=True)
class PointModel:
    """Observation model: number of points, on a round patch, `covered_percent` of the cortex, and noise.

    Points without correspondences are a cloud. A slipped registration displaces all by `slip` [m] along the cortex. One
    that is `is_misregistered` displaces or rotates all by `misplace_points`.
    """

    points: int
    covered_percent: int
    noise_level: int
    has_correspondences: bool = True
    slip: float = 0.0
    is_misregistered: bool = False


@dataclass(frozen=True)
class Estimate:
    """Estimate of one test case.

    Parameters
    ----------
    error, motion
        (q,) [m]: error, and length of the true motion, of each of the tumour's vertices.
    mahalanobis_square
        Square Mahalanobis distance of the centroid's error by the reported covariance; None without covariance.
    seconds
        Computing time [s] without the set-up for a body; None of the oracle and of rejected observations.
    is_rejected
        True if the observation was rejected: the estimate is then zero motion.
    has_slip
        True if the result reports a possible slip of the registration.
    has_warning
        True if a warning reports a wrong registration, a possible slip included.
    """

    error: np.ndarray
    motion: np.ndarray
    mahalanobis_square: float | None
    seconds: float | None
    is_rejected: bool = False
    has_slip: bool = False
    has_warning: bool = False


@dataclass(frozen=True)
class LocateRow:
    """Results of one estimator under one observation model.

    Parameters
    ----------
    removed
        Removed share [%] of the tumour's motion, summed over vertices and cases.
    mean, p95
        Error over vertices and cases [mm].
    held
        Share of cases [%] whose true centroid is inside the 95 % ellipsoid; None without ellipsoid.
    milliseconds
        Median time of an estimate; None of the oracle, which is no estimator.
    twins, refused, doubted, warned
        Numbers of cases, of rejected observations, of reported slips, and of warnings of a wrong registration.
    """

    points: int
    cover: int
    noise: int
    estimator: str
    removed: float
    mean: float
    p95: float
    held: float | None
    milliseconds: float | None
    twins: int
    refused: int
    doubted: int
    warned: int


def sample_observation(
    anatomy: Anatomy, motion: np.ndarray, point_model: PointModel, seed: tuple[int, ...]
) -> Observation:
    """Sample the observation of a motion (V, 3) [m] by an observation model, with its reported errors.

    The points are the same at every level of noise.
    """
    place = np.random.default_rng([*seed, point_model.points, point_model.covered_percent])
    evidence = sample_observed_patch(anatomy, motion, place, point_model.points, 1e-2 * point_model.covered_percent)
    rest, moved = evidence.positions[::3], evidence.motion.reshape(-1, 3)
    if point_model.slip:
        moved = moved + point_model.slip * _along(
            anatomy, np.random.default_rng([*seed, point_model.points, point_model.covered_percent, 3])
        )
    now, sigma, translation = rest + moved, np.full(len(rest), EXACT), TRANSLATIONS[point_model.noise_level]
    if point_model.noise_level:
        random = np.random.default_rng(
            [*seed, point_model.points, point_model.covered_percent, point_model.noise_level]
        )
        now, sigma = add_errors(rest, now, translation, random), None
    if point_model.is_misregistered:
        now = misplace_points(
            anatomy, now, np.random.default_rng([*seed, point_model.points, point_model.covered_percent, 4])
        )
    return Observation(now, rest if point_model.has_correspondences else None, sigma, rigid=translation / np.sqrt(3.0))


def misplace_points(anatomy: Anatomy, positions: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Displace or rotate positions (n, 3) [m] at random, within `WRONG_BY`."""
    way, rotates = random.standard_normal(3), random.uniform() < 0.5
    error = random.uniform(*WRONG_BY[rotates]) * way / np.linalg.norm(way)
    if not rotates:
        return positions + error
    middle = anatomy.mesh.nodes.mean(axis=0)
    return middle + Rotation.from_rotvec(error).apply(positions - middle)


def _along(body: Anatomy, random: np.random.Generator) -> np.ndarray:
    """Sample a unit vector (3,) perpendicular to the open cortex's axis."""
    way = np.cross(open_cortex(body).axis, random.standard_normal(3))
    return way / np.linalg.norm(way)


def add_errors(rest: np.ndarray, positions: np.ndarray, translation: float, random: np.random.Generator) -> np.ndarray:
    """Add independent, correlated and rigid errors to positions (n, 3) [m] of points from `rest` (n, 3) [m].

    The rigid error is half a degree about an axis through the points' centroid, and `translation` [m].
    """
    middle = rest.mean(axis=0)
    axis, way = random.standard_normal((2, 3))
    turn = Rotation.from_rotvec(TURN * axis / np.linalg.norm(axis))
    smooth = SMOOTH * compute_correlation_root(rest, LENGTH)
    off = WHITE * random.standard_normal(rest.shape) + smooth @ random.standard_normal(rest.shape)
    return middle + turn.apply(positions - middle) + translation * way / np.linalg.norm(way) + off


def measure_baselines(
    cases: Sequence[SyntheticCase], point_models: Sequence[PointModel], baselines: dict[str, Rival], locator: Locator,
    seed: int = 0, progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[LocateRow]:  # fmt: skip
    """Yield a row of every estimator under each observation model; baselines need points with correspondences.

    `progress` receives the number of observations done, and the total.

    Raises
    ------
    InputError
        No test cases, or an unknown level of noise.
    """
    if not cases:
        raise InputError("there is no twin to look at: of none was an equilibrium found.")
    for sight in point_models:
        if not 0 <= sight.noise_level < len(TRANSLATIONS):
            raise InputError(f"no noise is of level {sight.noise_level}: choose from 0 to {len(TRANSLATIONS) - 1}.")
    best = {twin.parameters.number: _best(locator, twin) for twin in cases}
    for number, sight in enumerate(point_models):
        asked = baselines if sight.has_correspondences else {}
        found: dict[str, list[Estimate]] = {name: [] for name in (*asked, OURS, ORACLE)}
        for done, twin in enumerate(cases, start=1):
            seen = sample_observation(locator.anatomy, twin.motion, sight, (seed, twin.parameters.number))
            for name, rival in asked.items():
                found[name].append(_rivalling(locator.anatomy, twin, rival, seen))
            found[OURS].append(evaluate_locator(locator, twin.motion, seen))
            found[ORACLE].append(best[twin.parameters.number])
            progress(number * len(cases) + done, len(point_models) * len(cases))
        for name, estimates in found.items():
            yield summarise_estimates(sight, name, estimates)


def build_point_models(
    points: Sequence[int], covers: Sequence[int], noises: Sequence[int], **others: Any
) -> tuple[PointModel, ...]:
    """Build all combinations, with `others` as further fields of `PointModel`."""
    return tuple(PointModel(*each, **others) for each in product(points, covers, noises))


def summarise_estimates(point_model: PointModel, name: str, estimates: Sequence[Estimate]) -> LocateRow:
    """Summarise the estimates of an estimator."""
    error, motion = (np.concatenate([getattr(each, key) for each in estimates]) for key in ("error", "motion"))
    squares = [each.mahalanobis_square for each in estimates if each.mahalanobis_square is not None]
    held = 100.0 * float(np.mean(np.array(squares) < RADIUS_SQUARED)) if squares else None
    seconds = [each.seconds for each in estimates if each.seconds is not None]
    return LocateRow(
        point_model.points, point_model.covered_percent, point_model.noise_level, name,
        removed=100.0 * float(1.0 - error.sum() / motion.sum()),
        mean=1e3 * float(error.mean()),
        p95=1e3 * float(np.percentile(error, 95.0)),
        held=held,
        milliseconds=1e3 * float(np.median(seconds)) if seconds else None,
        twins=len(estimates),
        refused=sum(each.is_rejected for each in estimates),
        doubted=sum(each.has_slip for each in estimates),
        warned=sum(each.has_warning for each in estimates),
    )  # fmt: skip


def compare_motion(
    estimated: np.ndarray, true: np.ndarray, mahalanobis_square: float | None, seconds: float | None,
    is_rejected: bool = False, has_slip: bool = False, has_warning: bool = False,
) -> Estimate:  # fmt: skip
    """Compare an estimated motion (q, 3) [m] of the tumour's vertices with the true motion (q, 3) [m]."""
    error, motion = np.linalg.norm(estimated - true, axis=1), np.linalg.norm(true, axis=1)
    return Estimate(error, motion, mahalanobis_square, seconds, is_rejected, has_slip, has_warning)


def evaluate_locator(locator: Locator, motion: np.ndarray, observation: Observation) -> Estimate:
    """Compare the locator's result for an observation with the true motion (V, 3) [m]."""
    body = locator.anatomy
    true = motion[body.tumour_nodes]
    try:
        found = locator.locate(observation)
    except InputError:
        return compare_motion(np.zeros_like(true), true, None, None, is_rejected=True)
    off = found.centroid - compute_centroid_motion(body, motion[None])[0]
    square = float(off @ np.linalg.solve(found.centroid_covariance, off))
    doubts = {"has_slip": found.slipped, "has_warning": found.is_registration_suspect}
    return compare_motion(found.compute_motion(body.tumour_nodes), true, square, found.seconds, **doubts)


def _rivalling(body: Anatomy, twin: SyntheticCase, rival: Rival, seen: Observation) -> Estimate:
    assert seen.rest is not None
    with limit_to_one_thread():  # matrix products are small
        found, seconds = time_work(rival, seen.rest, seen.now - seen.rest)
    return compare_motion(found, twin.motion[body.tumour_nodes], None, seconds)


def _best(locator: Locator, twin: SyntheticCase) -> Estimate:
    true = twin.motion[locator.anatomy.tumour_nodes]
    return compare_motion(fit_oracle(locator.prior, twin.motion), true, None, None)

"""Covariances that hold: the estimator is tried on members of tissues and skulls that its prior does not know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.geometry.locate import Located

from .causes import DRAINAGE, OEDEMA, SWELLING, TOOL, Presses
from .ensemble import Ensemble, surface_size
from .evidence import SIGMA, Evidence, of_motions
from .observation import Observation
from .posterior import Posterior
from .prior import Prior, middle_of, prior_of
from .rounds import settled

LEVEL = 0.95
"""Probability with which ellipsoids are made to hold."""
RADIUS_SQUARED = float(2.0 * gammaincinv(1.5, LEVEL))
"""The squared radius of a Gaussian's ellipsoid of that probability, in deviations: of chi-squared of three numbers."""
# Trials in all. So many of those most like an observation say how far its covariance must grow.
TRIALS, NEAREST = 960, 120
# What makes a cloud unlike all named points, in logarithms; and how much more than others that of the extent counts.
UNLIKE, EXTENT = 1e3, 4.0
# An observation may lie so far beyond all trials, in these logarithms: 400 points, the most that are looked at, do.
MARGIN = 0.05
# What moves the brain in a trial.
ALONE = (TOOL, DRAINAGE, SWELLING, OEDEMA)
# Points of a trial, the share of the open cortex that they lie on, how much softer its tissue is than the ensemble's,
# and errors as shares of the usual. Rigid errors along each axis [m], and how often there is none.
POINTS, COVER, SOFTER, ERRORS = (20, 400), (0.1, 1.0), (0.7, 2.0), (0.05, 1.0)
SHIFTS, UNSHIFTED = (0.05e-3, 3e-3), 0.25
# Of motion over error, so that its logarithm is finite.
LITTLE = 1e-3
# A member that moves the open cortex by less [m] is in no trial.
LEAST_SEEN = 0.5e-3


def trials(
    ensemble: Ensemble,
    presses: Presses,
    progress: Callable[[int, int], object] = lambda done, total: None,
    count: int = TRIALS,
) -> np.ndarray:
    """What came of `count` trials (k, 5): `likeness` of each, and its error's square by its own covariance.

    Groups are left out in turn, so that a trial's tissue, tumour and directions are unknown to its estimator. A motion
    in three is two causes' together. Rigid errors are as large as is stated, from none to 3 mm. In half of them the
    points have no names, and are a cloud. What is refused is no trial. None has a tip: with one, errors are smaller.

    Raises
    ------
    InputError
        No skull has two groups, of which one could be left out.
    """
    fold, found = left_out(ensemble), []
    if fold.max() < 0:
        raise InputError("no skull has two groups to try one by the other: give causes of several Poisson's ratios.")
    large = surface_size(ensemble.anatomy, ensemble.motion) > LEAST_SEEN
    for turn, numbers in enumerate(np.array_split(np.arange(count), fold.max() + 1)):
        prior, members = prior_of(ensemble, presses, fold != turn), np.flatnonzero((fold == turn) & large)
        for number in numbers:
            observation, middle = _trial(ensemble, members, int(number), np.random.default_rng(number))
            progress(int(number), count)
            try:
                posterior, _ = settled(prior, observation)
            except InputError:
                continue
            found.append([*likeness(posterior.evidence), _square(prior, posterior, middle)])
    progress(count, count)
    return np.array(found)


def left_out(ensemble: Ensemble) -> np.ndarray:
    """Turns (N,), from 0, in which members are left out: one group of each skull in each. -1: a skull's only group."""
    turn = np.full(len(ensemble.group), -1)
    for skull in np.unique(ensemble.skull):
        own = ensemble.skull == skull
        numbers, place = np.unique(ensemble.group[own], return_inverse=True)
        if len(numbers) > 1:
            turn[own] = place
    return turn


def covering_factor(tried: np.ndarray, evidence: Evidence) -> float:
    """By how much covariances must grow for ellipsoids of the tumour's middle to hold in 95 of 100 trials like this."""
    away = ((tried[:, :-1] - likeness(evidence)) ** 2).sum(axis=1)
    square = np.sort(tried[np.argsort(away, kind="stable")[:NEAREST], -1])
    rank = min(int(np.ceil(LEVEL * (len(square) + 1))), len(square))
    return float(square[rank - 1] / RADIUS_SQUARED)


def was_tried(tried: np.ndarray, evidence: Evidence) -> bool:
    """Whether such an observation lies within the range of the trials. They have the largest patch that there is."""
    own = likeness(evidence)
    alike = tried[tried[:, -2] == own[-1], :-1]
    within = len(alike) and (own >= alike.min(axis=0)).all()
    return bool(within and (own[[0, 1, 3]] <= alike[:, [0, 1, 3]].max(axis=0) + MARGIN).all())


def likeness(evidence: Evidence) -> np.ndarray:
    """What trials are compared by (4,): three logarithms, then 0, or `UNLIKE` for a cloud.

    They are of the seen motion over its error, the rigid one too, of the number of points, and of how large the seen
    patch is. That is their root mean square distance [m] from their middle, which counts `EXTENT` times. Of named
    points each gives three numbers, of a cloud one.
    """
    first = np.unique(evidence.point, return_index=True)[1]
    count, at = len(first), evidence.at[first]
    seen = np.sqrt((evidence.value**2).sum() / count)
    ratio = max(seen / np.hypot(np.median(evidence.sigma), evidence.shift), LITTLE)
    extent = np.sqrt(((at - at.mean(axis=0)) ** 2).sum(axis=1).mean())
    logs = np.log([ratio, count, extent]) * [1.0, 1.0, EXTENT]
    return np.append(logs, UNLIKE * (not evidence.named))


def _trial(
    ensemble: Ensemble, members: np.ndarray, number: int, random: np.random.Generator
) -> tuple[Observation, np.ndarray]:
    """What is seen of some member's motion, or of two; and how that moves the tumour's middle (3,) [m]."""
    anatomy = ensemble.anatomy
    here = members[ensemble.skull[members] == random.choice(np.unique(ensemble.skull[members]))]
    several = np.intersect1d(ALONE, ensemble.kind[here])
    causes = random.permutation(several)[: 1 + (number % 3 == 0)]
    chosen = [random.choice(here[ensemble.kind[here] == cause]) for cause in causes]
    softer = np.exp(random.uniform(*np.log(SOFTER)))
    motion = softer * ensemble.motion[chosen].sum(axis=0, dtype=float)
    evidence = seen_patch(anatomy, motion, random, int(np.exp(random.uniform(*np.log(POINTS)))), random.uniform(*COVER))
    sigma = np.full(len(evidence), SIGMA * np.exp(random.uniform(*np.log(ERRORS))))
    shift = 0.0 if random.uniform() < UNSHIFTED else float(np.exp(random.uniform(*np.log(SHIFTS))))
    evidence = replace(evidence, sigma=sigma, shift=shift)
    off = np.linalg.cholesky(evidence.noise()) @ random.standard_normal(len(evidence))
    way = random.standard_normal((2, 3))
    way *= np.sqrt(3.0) / np.linalg.norm(way, axis=1, keepdims=True)
    shifted, turned = evidence.rigid_scale.reshape(2, 3) * way
    rest = evidence.at[::3]
    now = rest + (evidence.value + off).reshape(-1, 3) + shifted + np.cross(turned, rest - evidence.middle)
    observation = Observation(now, rest if number % 2 else None, sigma[::3], rigid=shift)
    return observation, middle_of(anatomy, motion[None])[0]


def seen_patch(anatomy: Anatomy, motion: np.ndarray, random: np.random.Generator, count: int, cover: float) -> Evidence:
    """So many points on a round share `cover` of the open cortex, without error, of a motion (V, 3) [m]."""
    nodes, triangles = anatomy.mesh.nodes, anatomy.open_surface
    corners = nodes[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middles = corners.mean(axis=1)
    order = np.argsort(((middles - middles[random.choice(len(area), p=area / area.sum())]) ** 2).sum(axis=1))
    within = np.cumsum(area[order]) <= cover * area.sum()
    some = order[: max(4, np.count_nonzero(within))]
    triangle = random.choice(some, count, p=area[some] / area[some].sum())
    weights = random.dirichlet(np.ones(3), count)
    vertices = triangles[triangle]
    at, moved = (np.einsum("nc,nci->ni", weights, field[vertices]) for field in (nodes, motion))
    place = Located(np.column_stack([vertices, vertices[:, 0]]), np.column_stack([weights, np.zeros(count)]))
    return of_motions(place, at, moved, np.full(count, SIGMA))


def _square(prior: Prior, found: Posterior, middle: np.ndarray) -> float:
    """The square of an estimate's error (3,) [m], by its own covariance."""
    off = found.weight @ prior.middle - middle
    return float(off @ np.linalg.solve(found.covariance(prior.middle[:, None])[0], off))

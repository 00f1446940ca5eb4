"""Twin experiments: what of a known motion of a tumour is found from points on the open cortex, and how surely."""

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
from surrogate.locating.calibration import RADIUS_SQUARED, sample_seen_patch
from surrogate.locating.evidence import smooth_root
from surrogate.locating.locator import Locator
from surrogate.locating.observation import Observation
from surrogate.locating.prior import compute_middle

from .locate_rivals import Rival, oracle
from .locate_twins import Twin

OURS, ORACLE = "sulcus locate", "best sum of its shapes"
"""The locator, and what no estimator by its shapes can beat: it knows the truth."""
# What is stated of points without error [m], as a locator must be given some.
EXACT = 5e-5
# Errors of points: white and smooth [m], the smooth one's length [m], and the angle of the rigid one [rad].
WHITE, SMOOTH, LENGTH, TURN = 0.3e-3, 0.5e-3, 15e-3, float(np.radians(0.5))
TRANSLATIONS = (0.0, 1e-3, 2e-3)
"""Of the rigid error, at each level of noise [m]; at level 0 there is no error at all."""
# Least and greatest error of a wrong registration: a translation [m], or a rotation [rad] about the brain's middle.
WRONG_BY = (2e-3, 5e-3), (float(np.radians(2.0)), float(np.radians(4.0)))


@dataclass(frozen=True)
class PointsSeen:
    """What is seen: so many points, on a round share `cover` [%] of the open cortex, at a level of noise.

    Points without names are a cloud. A registration that slips displaces all by `slip` [m], along the open cortex. One
    that is `wrong` displaces or rotates all, as `misplaced` does.
    """

    points: int
    cover: int
    noise: int
    named: bool = True
    slip: float = 0.0
    wrong: bool = False


@dataclass(frozen=True)
class Estimate:
    """One estimate of one twin.

    Parameters
    ----------
    error, motion
        (q,) [m]: distance from the truth, and length of the true motion, of each of the tumour's vertices.
    square
        Square Mahalanobis distance of the centroid's error, by the stated covariance; None where none is stated.
    seconds
        What it took, what is made once for a body apart; None of the oracle and of what was refused.
    refused
        Whether the observation was refused: the tumour is then believed where the scan shows it.
    doubted
        Whether it was said that the registration may have slipped.
    warned
        True if a warning names a wrong registration, one that may have slipped included.
    """

    error: np.ndarray
    motion: np.ndarray
    square: float | None
    seconds: float | None
    refused: bool = False
    doubted: bool = False
    warned: bool = False


@dataclass(frozen=True)
class Row:
    """One estimator under one sight.

    Parameters
    ----------
    removed
        Share of the tumour's motion that is removed, [%] of its sum over vertices and twins.
    mean, p95
        Error over vertices and twins [mm].
    held
        Share of the twins [%] whose centroid lies in the ellipsoid that is said to hold 95 %; None: none is stated.
    milliseconds
        Median of an estimate; None of the oracle, which is none.
    twins, refused, doubted, warned
        Numbers of twins, of refused observations, of suspected slips, and of warnings of a wrong registration.
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


def observed(body: Anatomy, motion: np.ndarray, sight: PointsSeen, seed: tuple[int, ...]) -> Observation:
    """What is seen of a motion (V, 3) [m], with how far a tracker like this is off.

    Where the points lie is the same at every level of noise.
    """
    place = np.random.default_rng([*seed, sight.points, sight.cover])
    evidence = sample_seen_patch(body, motion, place, sight.points, 1e-2 * sight.cover)
    rest, moved = evidence.at[::3], evidence.value.reshape(-1, 3)
    if sight.slip:
        moved = moved + sight.slip * _along(body, np.random.default_rng([*seed, sight.points, sight.cover, 3]))
    now, sigma, translation = rest + moved, np.full(len(rest), EXACT), TRANSLATIONS[sight.noise]
    if sight.noise:
        random = np.random.default_rng([*seed, sight.points, sight.cover, sight.noise])
        now, sigma = spoilt(rest, now, translation, random), None
    if sight.wrong:
        now = misplaced(body, now, np.random.default_rng([*seed, sight.points, sight.cover, 4]))
    return Observation(now, rest if sight.named else None, sigma, rigid=translation / np.sqrt(3.0))


def misplaced(body: Anatomy, now: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Displace or rotate positions (n, 3) [m] at random, within `WRONG_BY`."""
    way, rotates = random.standard_normal(3), random.uniform() < 0.5
    error = random.uniform(*WRONG_BY[rotates]) * way / np.linalg.norm(way)
    if not rotates:
        return now + error
    middle = body.mesh.nodes.mean(axis=0)
    return middle + Rotation.from_rotvec(error).apply(now - middle)


def _along(body: Anatomy, random: np.random.Generator) -> np.ndarray:
    """A unit vector (3,) across the open cortex's axis, by chance."""
    way = np.cross(open_cortex(body).axis, random.standard_normal(3))
    return way / np.linalg.norm(way)


def spoilt(rest: np.ndarray, now: np.ndarray, translation: float, random: np.random.Generator) -> np.ndarray:
    """Positions (n, 3) [m] with a white, a smooth and a rigid error, of points that were at `rest` (n, 3) [m].

    The rigid one turns by half a degree about an axis through the points' middle, and moves by `translation` [m].
    """
    middle = rest.mean(axis=0)
    axis, way = random.standard_normal((2, 3))
    turn = Rotation.from_rotvec(TURN * axis / np.linalg.norm(axis))
    smooth = SMOOTH * smooth_root(rest, LENGTH)
    off = WHITE * random.standard_normal(rest.shape) + smooth @ random.standard_normal(rest.shape)
    return middle + turn.apply(now - middle) + translation * way / np.linalg.norm(way) + off


def rows(
    twins: Sequence[Twin],
    sights: Sequence[PointsSeen],
    rivals: dict[str, Rival],
    locator: Locator,
    seed: int = 0,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[Row]:
    """Every estimator under each sight, sight by sight; rivals where points have names, which they need.

    `progress` hears how many observations are done, and of how many.

    Raises
    ------
    InputError
        No twins, or a level of noise that there is not.
    """
    if not twins:
        raise InputError("there is no twin to look at: of none was an equilibrium found.")
    for sight in sights:
        if not 0 <= sight.noise < len(TRANSLATIONS):
            raise InputError(f"no noise is of level {sight.noise}: choose from 0 to {len(TRANSLATIONS) - 1}.")
    best = {twin.draw.number: _best(locator, twin) for twin in twins}
    for number, sight in enumerate(sights):
        asked = rivals if sight.named else {}
        found: dict[str, list[Estimate]] = {name: [] for name in (*asked, OURS, ORACLE)}
        for done, twin in enumerate(twins, start=1):
            seen = observed(locator.anatomy, twin.motion, sight, (seed, twin.draw.number))
            for name, rival in asked.items():
                found[name].append(_rivalling(locator.anatomy, twin, rival, seen))
            found[OURS].append(ours(locator, twin.motion, seen))
            found[ORACLE].append(best[twin.draw.number])
            progress(number * len(twins) + done, len(sights) * len(twins))
        for name, estimates in found.items():
            yield row(sight, name, estimates)


def sights_of(
    points: Sequence[int], covers: Sequence[int], noises: Sequence[int], **others: Any
) -> tuple[PointsSeen, ...]:
    """Every combination, with `others` of a `PointsSeen`."""
    return tuple(PointsSeen(*each, **others) for each in product(points, covers, noises))


def row(sight: PointsSeen, name: str, estimates: Sequence[Estimate]) -> Row:
    """What became of an estimator's estimates."""
    error, motion = (np.concatenate([getattr(each, key) for each in estimates]) for key in ("error", "motion"))
    squares = [each.square for each in estimates if each.square is not None]
    held = 100.0 * float(np.mean(np.array(squares) < RADIUS_SQUARED)) if squares else None
    seconds = [each.seconds for each in estimates if each.seconds is not None]
    return Row(
        sight.points, sight.cover, sight.noise, name,
        removed=100.0 * float(1.0 - error.sum() / motion.sum()),
        mean=1e3 * float(error.mean()),
        p95=1e3 * float(np.percentile(error, 95.0)),
        held=held,
        milliseconds=1e3 * float(np.median(seconds)) if seconds else None,
        twins=len(estimates),
        refused=sum(each.refused for each in estimates),
        doubted=sum(each.doubted for each in estimates),
        warned=sum(each.warned for each in estimates),
    )  # fmt: skip


def estimate(
    found: np.ndarray,
    true: np.ndarray,
    square: float | None,
    seconds: float | None,
    refused: bool = False,
    doubted: bool = False,
    warned: bool = False,
) -> Estimate:
    """An estimate of the motion (q, 3) [m] of the tumour's vertices, beside the truth (q, 3) [m]."""
    error, motion = np.linalg.norm(found - true, axis=1), np.linalg.norm(true, axis=1)
    return Estimate(error, motion, square, seconds, refused, doubted, warned)


def ours(locator: Locator, motion: np.ndarray, seen: Observation) -> Estimate:
    """What the locator says of an observation, beside the true motion (V, 3) [m]."""
    body = locator.anatomy
    true = motion[body.tumour_nodes]
    try:
        found = locator.locate(seen)
    except InputError:
        return estimate(np.zeros_like(true), true, None, None, refused=True)
    off = found.centroid - compute_middle(body, motion[None])[0]
    square = float(off @ np.linalg.solve(found.centroid_covariance, off))
    doubts = {"doubted": found.slipped, "warned": found.is_registration_suspect}
    return estimate(found.compute_motion(body.tumour_nodes), true, square, found.seconds, **doubts)


def _rivalling(body: Anatomy, twin: Twin, rival: Rival, seen: Observation) -> Estimate:
    assert seen.rest is not None
    with limit_to_one_thread():  # products are small
        found, seconds = time_work(rival, seen.rest, seen.now - seen.rest)
    return estimate(found, twin.motion[body.tumour_nodes], None, seconds)


def _best(locator: Locator, twin: Twin) -> Estimate:
    true = twin.motion[locator.anatomy.tumour_nodes]
    return estimate(oracle(locator.prior, twin.motion), true, None, None)

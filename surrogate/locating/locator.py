"""Where the tumour is, from what is seen of the brain's surface, with what is not known of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.runtime.threads import one_thread

from .calibration import covering_factor, was_tried
from .cause_shares import CauseShare, cause_shares, drawn_shares
from .causes import KINDS
from .observation import Observation, looked_at
from .posterior import Posterior, within_errors
from .prior import Prior
from .regions import Region
from .rounds import settled

# More points than this share are no outliers, and no cause of the ensemble moves what this is more surprised by.
MOST_OUTLIERS, MOST_SURPRISE = 0.35, 2.5
# The registration may have slipped where that makes what is seen so many times as probable, as a logarithm. On twins it
# does so for one of 432 motions, and for all slips of 8 to 20 mm along the cortex (docs/notes/locate_experiments.md).
DOUBTFUL = -2.0
# Least logarithm of a slip's probability over that of a motion for which a warning names the slip. True motions have
# -7 in the median (docs/notes/locate_experiments.md).
ALIKE = -2.5
# A rigid error is wide if it exceeds the reported one by this factor.
WIDE = 2.0
# What is said where swelling has a greater share than this.
SWELLS = 0.5
OEDEMA_WORDS = (
    "The brain swells or shrinks, by what was seen. If that is oedema round the tumour alone, the tumour moves about "
    "half as far, and ellipsoids often miss it: look for it in the scan."
)
# Normal numbers by which a radius is found that holds 95 in 100.
DRAWS = 4000


@dataclass(frozen=True)
class RigidAlone:
    """The rigid error that explains most of what was seen, with a body at rest: of least squares, however large.

    Parameters
    ----------
    share
        Of what was seen, in mean square, that it explains.
    shift, turn
        Its size [m], [rad].
    """

    share: float
    shift: float
    turn: float


@dataclass(frozen=True, eq=False)
class Location:
    """Where a tumour is, of the tumour and not of a model: Gaussian, in RAS.

    Parameters
    ----------
    prior
        What motions are made of.
    posterior
        The weights of its shapes and the rigid error, with covariances that were made to hold.
    p95
        [m]: with probability 0.95 the middle of the tumour is no farther from `centroid`.
    outliers, tips_left_out
        Numbers of points, and of tips, from 0. They lie off the open cortex, or no other point supports them.
    slipped
        Whether the registration may have slipped, by far more than is stated. Then the answer holds that too.
    checked
        Whether it was said that the registration was checked, so that no slip is suspected.
    calibrated
        Whether covariances were tried on observations like this: named points or a cloud, so many, and motions so far
        above errors, from a registration that did not slip.
    seconds
        What this took, set-up and tables that all observations share apart.
    """

    prior: Prior
    posterior: Posterior
    p95: float
    outliers: np.ndarray
    tips_left_out: np.ndarray
    slipped: bool
    checked: bool
    calibrated: bool
    seconds: float

    def at(self, nodes: np.ndarray) -> np.ndarray:
        """Mean motion (n, 3) [m] of vertices (n,)."""
        return np.tensordot(self.posterior.weight, self.prior.at(nodes), 1)

    def covariance(self, nodes: np.ndarray) -> np.ndarray:
        """Covariances (n, 3, 3) [m^2] of the motion of vertices (n,)."""
        return self.posterior.covariance(self.prior.at(nodes))

    @property
    def centroid(self) -> np.ndarray:
        """(3,) [m]: how far the middle of the tumour's volume has moved, as a mean."""
        return self.posterior.weight @ self.prior.middle

    @property
    def centroid_covariance(self) -> np.ndarray:
        """(3, 3) [m^2] of that."""
        return self.posterior.covariance(self.prior.middle[:, None])[0]

    @property
    def bias(self) -> np.ndarray:
        """(3,) [m]: how far the observation as a whole seems shifted, at the middle of its points."""
        return self.posterior.rigid[:3]

    @property
    def rotation(self) -> np.ndarray:
        """(3,) [rad]: how far it seems turned about that."""
        return self.posterior.rigid[3:]

    @property
    def explained(self) -> float:
        """Share of the seen motion, in mean square, that the mean motion and the rigid error explain."""
        evidence, found = self.posterior.evidence, self.posterior
        left = evidence.value - self.prior.seen(*evidence.weights) @ found.weight
        left -= evidence.rigid @ found.rigid
        whole = float(evidence.value @ evidence.value)
        return max(0.0, 1.0 - float(left @ left) / whole) if whole else 0.0

    @property
    def rigid_alone(self) -> RigidAlone:
        """What another rigid error would explain of what was seen, if nothing had moved."""
        evidence = self.posterior.evidence
        found = evidence.rigid_alone
        left, whole = evidence.value - evidence.rigid @ found, float(evidence.value @ evidence.value)
        shift, turn = np.linalg.norm(found.reshape(2, 3), axis=1)
        return RigidAlone(1.0 - float(left @ left) / whole if whole else 0.0, float(shift), float(turn))

    @cached_property
    def within_errors(self) -> bool:
        """Whether nothing need have moved for what was seen: it is no more than errors that are stated."""
        return within_errors(self.posterior)

    @cached_property
    def cause_shares(self) -> tuple[CauseShare, ...]:
        """What moved the open cortex, as far as causes are separable, the largest share first.

        None where what was seen is within its errors, or the registration may have slipped.
        """
        return () if self.slipped or self.within_errors else cause_shares(self._drawn_shares)

    @property
    def causes(self) -> dict[str, float]:
        """Mean share of each of `KINDS` in what they move the open cortex by, in mean square; they sum to 1.

        All are 0 where no cause is named. Single shares are guesses where causes are not separable.
        """
        share = self._drawn_shares.mean(axis=0) if self.cause_shares else np.zeros(len(KINDS))
        return dict(zip(KINDS, share.tolist(), strict=True))

    @cached_property
    def _drawn_shares(self) -> np.ndarray:
        return drawn_shares(self.prior, self.posterior)

    @property
    def doubt(self) -> str:
        """Why ellipsoids may not hold, in sentences; none if they were tried."""
        if self.slipped:
            return (
                f"It is a guess, as the registration may have slipped. {self._rigid_words} explains what was seen "
                "about as well as any motion does. The two cannot be distinguished: check it."
            )
        if not self.calibrated:
            return (
                "It is a guess: ellipsoids were not tried on so few or many points, so small a patch, or "
                "motions so near or far above errors."
            )
        return ""

    @property
    def is_registration_suspect(self) -> bool:
        """Return True if a wrong registration explains the observation nearly as well as a motion does."""
        found, checked = self.posterior, self.checked
        return self.slipped or (not checked and found.evidence.beyond > WIDE and found.slipped >= ALIKE)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What else must be known of the answer, in sentences: what would look alike, and `doubt`."""
        named = self.is_registration_suspect and not self.slipped
        rigid = (
            f"{self._rigid_words} would explain {self.rigid_alone.share:.0%}, with a brain at rest. The two cannot be "
            "distinguished. If it may be off so far, say so by --rigid."
        )
        swells = self.causes["swelling"] + self.causes["oedema"] > SWELLS
        return tuple(said for said in (rigid if named else "", OEDEMA_WORDS if swells else "", self.doubt) if said)

    @property
    def _rigid_words(self) -> str:
        """The rigid error that explains most with a body at rest, and what was stated."""
        alone = self.rigid_alone
        stated = self.posterior.evidence.rigid_scale
        return (
            f"A registration that is off by {1e3 * alone.shift:.1f} mm and {np.degrees(alone.turn):.1f} degrees, where "
            f"{1e3 * stated[0]:.2g} mm and {np.degrees(stated[3]):.2g} degrees are stated,"
        )

    @property
    def named_causes(self) -> str:
        """The same in words, or why none is named."""
        if self.slipped:
            return "not said, as the registration may have slipped"
        if self.within_errors:
            return "none, as what was seen is within its errors"
        return ", ".join(map(str, self.cause_shares))


@dataclass(frozen=True, eq=False)
class Locator:
    """Answers observations of one anatomy; made once (`make_locator`), it answers any number of them.

    Parameters
    ----------
    prior
        What is believed of motions before they are seen.
    tried
        (k, 5): what came of trials (`calibration.trials`).
    regions
        Those whose stiffness was known.
    """

    prior: Prior
    tried: np.ndarray
    regions: tuple[Region, ...] = ()

    @property
    def anatomy(self) -> Anatomy:
        """The body."""
        return self.prior.anatomy

    def small(self) -> Locator:
        """The same, of the vertices alone that tell of the open cortex and of the tumour: a tenth of the size.

        It locates what is seen on the open cortex itself, and cannot say how other tissue moved.
        """
        return replace(self, prior=self.prior.restricted(telling_nodes(self.anatomy)))

    def locate(self, observation: Observation) -> Location:
        """Where the tumour is by one observation.

        Raises
        ------
        InputError
            An observation that is too small, lies elsewhere, or that no cause of the ensemble explains.
        """
        with one_thread():  # products are small
            return self._located(observation)

    def _located(self, observation: Observation) -> Location:
        prior, count = self.prior, len(observation.now)
        prior.prepare()
        begun = time.perf_counter()
        found, near = settled(prior, observation)
        slipped = not observation.checked and _may_have_slipped(prior.anatomy, found)
        if slipped:
            found, near = settled(prior, observation, free=True)
        some = looked_at(count)
        outliers = np.union1d(np.setdiff1d(some, near), found.outliers[found.outliers < count])
        _demand_explained(found, len(outliers), len(some))
        found = replace(found, factor=covering_factor(self.tried, found.evidence))
        return Location(
            prior=prior,
            posterior=found,
            p95=radius_of(found.covariance(prior.middle[:, None])[0]),
            outliers=outliers,
            tips_left_out=found.outliers[found.outliers >= count] - count,
            slipped=slipped,
            checked=observation.checked,
            calibrated=not slipped and was_tried(self.tried, found.evidence),
            seconds=time.perf_counter() - begun,
        )


def telling_nodes(anatomy: Anatomy) -> np.ndarray:
    """Sorted vertices (n,) of the tumour, and of all tetrahedra at the open cortex."""
    mesh = anatomy.mesh
    at_cortex = np.isin(mesh.tets, anatomy.open_surface).any(axis=1)
    return np.union1d(mesh.tets[at_cortex], anatomy.tumour_nodes)


def radius_of(covariance: np.ndarray) -> float:
    """How far [m] 95 in 100 draws of a Gaussian of some covariance (3, 3) [m^2] are from its mean, at most."""
    drawn = _normal() @ np.linalg.cholesky(covariance).T
    return float(np.quantile(np.sqrt((drawn**2).sum(axis=1)), 0.95))


@cache
def _normal() -> np.ndarray:
    """Normal numbers (DRAWS, 3)."""
    return np.random.default_rng(0).standard_normal((DRAWS, 3))


def _may_have_slipped(anatomy: Anatomy, found: Posterior) -> bool:
    """Whether a slip beyond what is stated makes what is seen nearly as probable as a motion does, and does not sink.

    A brain that sinks by a centimetre moves as rigidly as one whose registration is off, but mostly along its opening's
    axis, and all of it alike. A slip shifts it across, or turns it.
    """
    if found.slipped < DOUBTFUL or found.evidence.beyond <= WIDE:
        return False
    evidence, axis = found.evidence, open_cortex(anatomy).axis
    shift, turn = np.split(evidence.rigid_alone, 2)
    sunk = axis @ shift
    other = shift - sunk * axis + np.cross(turn, evidence.at - evidence.middle)
    return bool((other**2).sum(axis=1).mean() > sunk**2)


def _demand_explained(found: Posterior, outliers: int, points: int) -> None:
    """Refuse an observation that the ensemble does not know.

    Raises
    ------
    InputError
        Too many outliers, or residuals that are no noise.
    """
    if outliers > MOST_OUTLIERS * points:
        raise InputError(
            f"{outliers} of {points} points lie off the open cortex, or fit no motion of the others: check that "
            "they are of this brain. If they are less sure, raise sigma."
        )
    if found.surprise > MOST_SURPRISE:
        raise InputError(
            f"the observation fits no cause: its points are off by {np.sqrt(found.surprise):.1f} times their sigma. "
            "Check units, frame (RAS) and sigma, or that nothing was cut out."
        )

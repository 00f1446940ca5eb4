"""Estimation of the tumour's position from observations of the brain's surface, as a posterior distribution."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cache, cached_property
from operator import attrgetter

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.runtime.threads import limit_to_one_thread

from .calibration import compute_coverage_factor, is_within_trials
from .cause_shares import CauseShare, compute_cause_shares, group_cause_shares
from .causes import KINDS
from .iterated_conditioning import match_and_update
from .observation import Observation, choose_point_numbers
from .posterior import Posterior, is_within_errors
from .prior import MotionPrior
from .regions import Region

OEDEMA_WORDS = (  # Warning for brains that swell.
    "The brain swells or shrinks, by what was seen. If that is oedema round the tumour alone, the tumour moves about "
    "half as far, and ellipsoids often miss it: look for it in the scan."
)
SAMPLE_COUNT = 4000  # Number of normal samples from which the 95 % radius is estimated.


@dataclass(frozen=True)
class LocationLimits:
    """Limits beyond which a location is rejected or has a warning."""

    max_outlier_share: float = 0.35  # Largest share of outliers.
    max_surprise: float = 2.5  # Largest `Posterior.surprise` of an accepted observation.
    # Smallest log-odds of a registration slip against a motion for which a slip is assumed possible: in synthetic tests
    # one of 432 motions, and all slips of 8 to 20 mm along the cortex (docs/notes/locate_experiments.md).
    min_slip_log_odds: float = -2.0
    # Smallest log-odds of a slip against a motion for which a warning names the slip. True motions have -7 in the
    # median (docs/notes/locate_experiments.md).
    warning_log_odds: float = -2.5
    max_rigid_ratio: float = 2.0  # Ratio to the reported rigid error above which an estimated one counts as excessive.
    swelling_share: float = 0.5  # Share of swelling and oedema above which `OEDEMA_WORDS` is reported.


LIMITS = LocationLimits()


@dataclass(frozen=True)
class RigidExplanation:
    """Rigid error that fits the observation best by least squares, with the brain undeformed.

    Parameters
    ----------
    share
        Share of the observation's mean square that the rigid error explains.
    shift, turn
        Magnitude of its translation [m] and rotation [rad].
    """

    share: float
    shift: float
    turn: float


@dataclass(frozen=True, eq=False)
class Location:
    """Posterior of the tumour's position: a Gaussian, in RAS.

    Parameters
    ----------
    prior
        Prior of motions.
    posterior
        Posterior of the shapes' weights and of the rigid error, with calibrated covariances.
    p95
        Radius [m] round `centroid` that contains the tumour's centroid with probability 0.95.
    outliers, outlier_tips
        Indices of the rejected points and tips, which are far from the open cortex or not supported by other points.
    slipped
        True if the registration error may be far larger than reported; the posterior then includes such an error.
    checked
        True if the user has checked the registration, so that no slip is assumed.
    calibrated
        True if covariances were calibrated on similar observations (correspondences, number of points, motion over
        error) and the registration did not slip.
    seconds
        Computing time [s], without the tables that all observations share.
    """

    prior: MotionPrior
    posterior: Posterior
    p95: float
    outliers: np.ndarray
    outlier_tips: np.ndarray
    slipped: bool
    checked: bool
    calibrated: bool
    seconds: float

    def compute_motion(self, nodes: np.ndarray) -> np.ndarray:
        """Compute the mean motion (n, 3) [m] of the vertices `nodes` (n,)."""
        return np.tensordot(self.posterior.shape_weights, self.prior.restrict_shapes(nodes), 1)

    def compute_covariance(self, nodes: np.ndarray) -> np.ndarray:
        """Compute covariances (n, 3, 3) [m^2] of the motions of the vertices `nodes` (n,)."""
        return self.posterior.compute_covariance(self.prior.restrict_shapes(nodes))

    @property
    def centroid(self) -> np.ndarray:
        """Mean motion (3,) [m] of the tumour's centroid (by volume)."""
        return self.posterior.shape_weights @ self.prior.centroid_motion

    @property
    def centroid_covariance(self) -> np.ndarray:
        """Covariance (3, 3) [m^2] of the motion of the tumour's centroid."""
        return self.posterior.compute_covariance(self.prior.centroid_motion[:, None])[0]

    @property
    def bias(self) -> np.ndarray:
        """Mean registration shift (3,) [m] of the observation, at the centroid of its points."""
        return self.posterior.rigid_error[:3]

    @property
    def rotation(self) -> np.ndarray:
        """Mean registration rotation (3,) [rad] of the observation, about the centroid of its points."""
        return self.posterior.rigid_error[3:]

    @property
    def explained(self) -> float:
        """Share of the observed mean square motion that the mean motion and the rigid error explain together."""
        evidence, found = self.posterior.evidence, self.posterior
        left = evidence.motion - self.prior.project_shapes(*evidence.weights) @ found.shape_weights
        left -= evidence.rigid_jacobian @ found.rigid_error
        whole = float(evidence.motion @ evidence.motion)
        return max(0.0, 1.0 - float(left @ left) / whole) if whole else 0.0

    @property
    def rigid_alone(self) -> RigidExplanation:
        """Rigid error that would explain most of the observation, with the brain undeformed."""
        evidence = self.posterior.evidence
        found = evidence.rigid_fit
        left, whole = (evidence.motion - evidence.rigid_jacobian @ found, float(evidence.motion @ evidence.motion))
        shift, turn = np.linalg.norm(found.reshape(2, 3), axis=1)
        return RigidExplanation(1.0 - float(left @ left) / whole if whole else 0.0, float(shift), float(turn))

    @cached_property
    def within_errors(self) -> bool:
        """True if the observation is within its reported errors: then no motion is significant."""
        return is_within_errors(self.posterior)

    @cached_property
    def cause_shares(self) -> tuple[CauseShare, ...]:
        """Shares of causes in the open cortex's motion, as far as separable, largest share first.

        Empty if the observation is within its errors, or if the registration may have slipped.
        """
        return () if self.slipped or self.within_errors else group_cause_shares(self._sampled_shares)

    @property
    def causes(self) -> dict[str, float]:
        """Mean share of each of `KINDS` in the mean square motion of the open cortex; the shares sum to 1.

        All shares are 0 if `cause_shares` is empty. Shares of inseparable causes are rough estimates.
        """
        share = self._sampled_shares.mean(axis=0) if self.cause_shares else np.zeros(len(KINDS))
        return dict(zip(KINDS, share.tolist(), strict=True))

    @cached_property
    def _sampled_shares(self) -> np.ndarray:
        return compute_cause_shares(self.prior, self.posterior)

    @property
    def doubt(self) -> str:
        """Reason why the ellipsoids may be unreliable, in sentences; empty if they are calibrated."""
        if self.slipped:
            return (
                f"It is a guess, as the registration may have slipped. {self._rigid_error_text} explains what was seen "
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
        """True if a wrong registration explains the observation nearly as well as a motion does."""
        found, checked = self.posterior, self.checked
        return self.slipped or (
            not checked
            and found.evidence.rigid_ratio > LIMITS.max_rigid_ratio
            and found.slip_log_odds >= LIMITS.warning_log_odds
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about this result, in sentences: other explanations of the observation, and `doubt`."""
        named = self.is_registration_suspect and not self.slipped
        rigid = (
            f"{self._rigid_error_text} would explain {self.rigid_alone.share:.0%}, with a brain at rest. The two "
            "cannot be distinguished. If such an error is possible, give it by --rigid."
        )
        swells = self.causes["swelling"] + self.causes["oedema"] > LIMITS.swelling_share
        return tuple(said for said in (rigid if named else "", OEDEMA_WORDS if swells else "", self.doubt) if said)

    @property
    def _rigid_error_text(self) -> str:
        """Text that compares the best-fitting rigid error, with the brain undeformed, with the reported one."""
        alone = self.rigid_alone
        stated = self.posterior.evidence.rigid_scale
        return (
            f"A registration error of {1e3 * alone.shift:.1f} mm and {np.degrees(alone.turn):.1f} degrees, where "
            f"{1e3 * stated[0]:.2g} mm and {np.degrees(stated[3]):.2g} degrees are reported,"
        )

    @property
    def named_causes(self) -> str:
        """Description of `cause_shares`, or the reason why it is empty."""
        if self.slipped:
            return "not said, as the registration may have slipped"
        if self.within_errors:
            return "none, as what was seen is within its errors"
        return ", ".join(map(str, self.cause_shares))

    # Former names, for one release.
    at, covariance, tips_left_out = compute_motion, compute_covariance, property(attrgetter("outlier_tips"))


@dataclass(frozen=True, eq=False)
class Locator:
    """Estimator of the tumour's motion in one anatomy, built once (`make_locator`) for all its observations.

    Parameters
    ----------
    prior
        Prior of motions.
    tried
        Results (k, 5) of the trials (`calibration.run_trials`).
    regions
        Regions of known stiffness.
    """

    prior: MotionPrior
    tried: np.ndarray
    regions: tuple[Region, ...] = ()

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy of the prior."""
        return self.prior.anatomy

    def restrict(self) -> Locator:
        """Return this locator restricted to vertices at the open cortex and in the tumour, with a tenth of the size.

        The restricted locator accepts only observations on the open cortex, and has no motion of other tissue.
        """
        return replace(self, prior=self.prior.restrict(find_observed_nodes(self.anatomy)))

    def locate(self, observation: Observation) -> Location:
        """Estimate the tumour's position from one observation.

        Raises
        ------
        InputError
            The observation has too few points or is far from the cortex, or no cause in the ensemble explains it.
        """
        with limit_to_one_thread():  # matrix products are small
            return self._locate_tumour(observation)

    def _locate_tumour(self, observation: Observation) -> Location:
        prior, count = self.prior, len(observation.now)
        prior.prepare()
        begun = time.perf_counter()
        found, near = match_and_update(prior, observation)
        slipped = not observation.checked and _is_slip_likely(prior.anatomy, found)
        if slipped:
            found, near = match_and_update(prior, observation, allow_slip=True)
        some = choose_point_numbers(count)
        outliers = np.union1d(np.setdiff1d(some, near), found.outliers[found.outliers < count])
        _check_outliers(found, len(outliers), len(some))
        found = replace(found, covariance_factor=compute_coverage_factor(self.tried, found.evidence))
        return Location(
            prior=prior,
            posterior=found,
            p95=compute_confidence_radius(found.compute_covariance(prior.centroid_motion[:, None])[0]),
            outliers=outliers,
            outlier_tips=found.outliers[found.outliers >= count] - count,
            slipped=slipped,
            checked=observation.checked,
            calibrated=not slipped and is_within_trials(self.tried, found.evidence),
            seconds=time.perf_counter() - begun,
        )

    small = restrict  # Former names, for one release.


def find_observed_nodes(anatomy: Anatomy) -> np.ndarray:
    """Return the sorted vertices (n,) of the tumour and of all tetrahedra with a vertex on the open cortex."""
    mesh = anatomy.mesh
    at_cortex = np.isin(mesh.tets, anatomy.open_surface).any(axis=1)
    return np.union1d(mesh.tets[at_cortex], anatomy.tumour_nodes)


def compute_confidence_radius(covariance: np.ndarray) -> float:
    """Compute the radius [m] that contains 95 % of a Gaussian with `covariance` (3, 3) [m^2], round its mean."""
    drawn = _sample_normal() @ np.linalg.cholesky(covariance).T
    return float(np.quantile(np.sqrt((drawn**2).sum(axis=1)), 0.95))


@cache
def _sample_normal() -> np.ndarray:
    """Sample standard normal numbers (SAMPLE_COUNT, 3), with a fixed seed."""
    return np.random.default_rng(0).standard_normal((SAMPLE_COUNT, 3))


def _is_slip_likely(anatomy: Anatomy, posterior: Posterior) -> bool:
    """Return True if a slip explains the observation nearly as well as a motion does, and is not like a sinking brain.

    A brain that sinks by a centimetre resembles a registration shift, but it moves uniformly and mostly along the
    craniotomy's axis. A slip moves the brain across this axis, or rotates it.
    """
    if posterior.slip_log_odds < LIMITS.min_slip_log_odds or posterior.evidence.rigid_ratio <= LIMITS.max_rigid_ratio:
        return False
    evidence, axis = posterior.evidence, open_cortex(anatomy).axis
    shift, turn = np.split(evidence.rigid_fit, 2)
    sunk = axis @ shift
    other = shift - sunk * axis + np.cross(turn, evidence.positions - evidence.centroid)
    return bool((other**2).sum(axis=1).mean() > sunk**2)


def _check_outliers(posterior: Posterior, outliers: int, points: int) -> None:
    """Check that the ensemble explains the observation.

    Raises
    ------
    InputError
        There are too many outliers, or the residuals are larger than the reported errors.
    """
    if outliers > LIMITS.max_outlier_share * points:
        raise InputError(
            f"{outliers} of {points} points lie off the open cortex, or fit no motion of the others: check that "
            "they are of this brain. If they are less sure, raise sigma."
        )
    if posterior.surprise > LIMITS.max_surprise:
        raise InputError(
            f"the observation fits no cause: point errors of {np.sqrt(posterior.surprise):.1f} times their sigma. "
            "Check units, frame (RAS) and sigma, or that nothing was cut out."
        )

"""Posterior of motions as a mixture of Gaussians.

A prior motion is a sum of shapes with independent weights (Rasmussen, Williams 2006, "Gaussian Processes for Machine
Learning", section 2.1). A hypothesis is a set of causes, and is weighted by its evidence (equation 5.8). As shapes only
approximate tissue, the evidence is raised to a power below 1: Miller, Dunson 2019, "Robust Bayesian inference via
coarsening", J. Am. Stat. Assoc. 114:1113-1125. Leave-one-out residuals: Sundararajan, Keerthi 2001, "Predictive
approaches for choosing hyperparameters in Gaussian processes", Neural Comput. 13:1103-1118.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.special import chdtrc, chdtri, logsumexp

from sim.errors import InputError

from .causes import OEDEMA, TOOL
from .evidence import SHIFT_ERROR, SLIPPED_ERROR, Evidence, invert_triangular
from .prior import CAUSE_SETS, PLACE_SETS, RIGID_RATIOS, Hypothesis, MotionPrior
from .whitened import NormalEquations, WhitenedSystem, add_place_unknowns, whiten_system

NO_TIPS, NO_ROWS = np.zeros((0, 3)), np.zeros(0, int)  # Empty arrays: no tool tips (0, 3), no rows (0,).
RIGID_KIND = -1  # Kind of the unknowns of the rigid error, next to the numbers of causes.
(potrs,) = get_lapack_funcs(("potrs",), dtype=np.float64)


@dataclass(frozen=True)
class PosteriorSettings:
    """Settings of `condition_prior` and `is_within_errors`."""

    motion_significance: float = 0.005  # Significance level of a motion, for each of three tests.
    outlier_significance: float = 1e-4  # Significance level of an outlier.
    min_inliers: int = 4  # Minimum number of remaining points; if reached, no outlier is tested.
    evidence_divisor: float = 2.0  # Divisor of the log evidence, for model errors of the shapes.
    max_hypotheses: int = 24  # Maximum number of hypotheses in the mixture: the most probable ones.


POSTERIOR = PosteriorSettings()


def is_within_errors(posterior: Posterior) -> bool:
    """Return True if the observation is within its errors, rigid error included, so that no motion is significant.

    Two tests are on the observation's size: its squared Mahalanobis distance is the sum of a rigid part, by generalised
    least squares, and a remainder, which are both chi-squared. The third test is on its form: the ratio of the mean
    evidence of prior motions to that of errors alone. By Markov's inequality, errors alone exceed a ratio of 1 / p with
    a probability of p at most. This test detects a dent whose total size is within the errors.
    """
    evidence = posterior.evidence
    whitening, scale = evidence.build_whitening(0.0), evidence.rigid_scale
    rigid, white = whitening.whiten(evidence.rigid_jacobian * scale), whitening.whiten(evidence.motion)
    precision, gain = rigid.T @ rigid, rigid.T @ white
    whole = np.eye(6) + precision
    found = np.linalg.lstsq(precision, gain, rcond=None)[0]
    together = found @ np.linalg.solve(whole, precision @ found)
    rest = ((white - rigid @ found) ** 2).sum()
    if min(chdtrc(6, together), chdtrc(len(white) - 6, rest)) <= POSTERIOR.motion_significance:
        return False
    still = 0.5 * (gain @ np.linalg.solve(whole, gain) - np.linalg.slogdet(whole)[1] - white @ white)
    return bool(posterior.motion_evidence - still - whitening.log_determinant < -np.log(POSTERIOR.motion_significance))


@dataclass(frozen=True, eq=False)
class HypothesisResult:
    """Posterior of k unknowns under one hypothesis.

    Parameters
    ----------
    probability
        Probability of the hypothesis.
    rows, mean
        Row numbers (k,) of the unknowns, and their posterior means.
    prior_deviations
        Prior standard deviations (k,) of the unknowns.
    cholesky
        Cholesky factor (k, k) of the precision of the unknowns, each divided by its prior standard deviation.
    """

    probability: float
    rows: np.ndarray
    mean: np.ndarray
    prior_deviations: np.ndarray
    cholesky: np.ndarray

    @cached_property
    def root(self) -> np.ndarray:
        """Factor R (k, k) of the unknowns' posterior covariance R^T R."""
        return self.prior_deviations * invert_triangular(self.cholesky)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of motions: mixture over the most probable hypotheses.

    Parameters
    ----------
    evidence
        Evidence without outliers.
    results
        Posteriors of the hypotheses; their probabilities sum to 1.
    unknowns
        Mean (r + 6,) of the shapes' weights, and of the rigid error divided by its prior standard deviations.
    surprise
        Mean over rows of the squared Mahalanobis distance from leave-one-out predictions; about 1 if the model fits.
    outliers
        Numbers of the points that were removed as outliers.
    slip_log_odds
        Log-odds of a slipped registration: best hypothesis with a slip against the best hypothesis without one.
    motion_evidence
        Log evidence of motions, see `ObservedPrior.motion_evidence`.
    covariance_factor
        Calibrated factor on the mixture's covariances.
    """

    evidence: Evidence
    results: list[HypothesisResult]
    unknowns: np.ndarray
    surprise: float
    outliers: np.ndarray
    slip_log_odds: float
    motion_evidence: float
    covariance_factor: float = 1.0

    @property
    def shape_weights(self) -> np.ndarray:
        """Posterior mean (r,) of the shapes' weights."""
        return self.unknowns[:-6]

    @property
    def rigid_error(self) -> np.ndarray:
        """Posterior mean (6,) of the rigid error: translation [m], then rotation [rad]."""
        return self.unknowns[-6:] * self.evidence.rigid_scale

    def compute_bias(self, positions: np.ndarray) -> np.ndarray:
        """Compute the posterior mean of the rigid error's displacement (n, 3) [m] at positions (n, 3) [m]."""
        return self.rigid_error[:3] + np.cross(self.rigid_error[3:], positions - self.evidence.centroid)

    def compute_covariance(self, shapes: np.ndarray) -> np.ndarray:
        """Compute the covariances (q, 3, 3) [m^2] of the motions of q points, given their shapes (r, q, 3) [m]."""
        flat = np.pad(shapes.reshape(len(shapes), -1), ((0, 6), (0, 0)))  # a rigid error moves no tissue
        mean, found = self.unknowns @ flat, np.zeros((shapes.shape[1], 3, 3))
        for result in self.results:
            part = flat[result.rows]
            off = np.concatenate([result.root @ part, [result.mean @ part - mean]])
            off = off.reshape(len(off), -1, 3).transpose(1, 2, 0)
            found += result.probability * off @ off.transpose(0, 2, 1)
        return self.covariance_factor * found


@dataclass(frozen=True, eq=False)
class ObservedPrior:
    """Prior at the observed points, whitened by their error covariance.

    Parameters
    ----------
    prior
        Prior of motions.
    motion_size
        Prior root mean square size of motions [mm].
    system
        Whitened effect on the observation of unit shape weights and of a rigid error of one standard deviation.
    log_odds
        Log-odds of places, see `MotionPrior.compute_log_odds`.
    slip_ratio
        Size of a slip relative to the reported rigid error, see `Evidence.slip_ratio`.
    is_paired
        True if points have correspondences. For point clouds oedema is excluded, as their errors resemble oedema.
    """

    prior: MotionPrior
    motion_size: float
    system: WhitenedSystem
    log_odds: np.ndarray
    slip_ratio: float = SLIPPED_ERROR / SHIFT_ERROR
    is_paired: bool = True

    @property
    def slip_log_odds(self) -> float:
        """Log-odds of a slipped registration, as in `Posterior`."""
        best = self.log_evidence.max(axis=1)
        return POSTERIOR.evidence_divisor * float(best[self._has_slip].max() - best[~self._has_slip].max())

    @property
    def motion_evidence(self) -> float:
        """Logarithm of the mean evidence of motions, for a registration within its reported error.

        The log-odds of places are left out, as a tool tip gives no information on motion.
        """
        logs = POSTERIOR.evidence_divisor * (self.log_evidence - self.log_odds)[~self._has_slip]
        logs, rows = logs[np.isfinite(logs)], self.system
        return float(logsumexp(logs) - np.log(len(logs)) - 0.5 * rows.products[-1, -1] + rows.whitening.log_determinant)

    @property
    def _has_slip(self) -> np.ndarray:
        """Mask (h,) of the hypotheses with a slipped registration."""
        return np.isinf([hypothesis.rigid_ratio for hypothesis in self.prior.hypotheses])

    def compute_posteriors(self, allow_slip: bool = False) -> list[HypothesisResult]:
        """Compute the posteriors of the most probable hypotheses, best first; their probabilities sum to 1.

        Hypotheses with a slipped registration are included if `allow_slip`.
        """
        logs = self.log_evidence if allow_slip else np.where(self._has_slip[:, None], -np.inf, self.log_evidence)
        best = np.argsort(-logs, axis=None, kind="stable")[: min(POSTERIOR.max_hypotheses, np.isfinite(logs).sum())]
        share = np.exp(logs.flat[best] - logs.flat[best[0]])
        share /= share.sum()
        found = []
        for own, number, place in zip(share, *np.unravel_index(best, logs.shape), strict=True):
            hypothesis = self.prior.hypotheses[number]
            rows = hypothesis.place_rows[place - 1] if place else NO_ROWS
            found.append(self.compute_posterior(hypothesis, rows, float(own)))
        return found

    @cached_property
    def log_evidence(self) -> np.ndarray:
        """Log of prior odds and coarsened evidence (h, 1 + p) of the hypotheses, up to a common constant.

        Column 0 is without a pressing tool, the others are for a tool on each place; -inf where excluded.
        """
        # All hypotheses include tools all over the cortex and the rigid error, and each set extends an earlier one.
        rigid = (
            self._build_equations()
            .eliminate_unknowns(TOOL)
            .scale_unknowns(RIGID_KIND, np.minimum(RIGID_RATIOS, self.slip_ratio))
            .eliminate_unknowns(RIGID_KIND)
        )
        found: dict[tuple[int, ...], NormalEquations] = {}
        extended = {some[:-1] for some in CAUSE_SETS}
        evidence = np.full((*rigid.log_evidence.shape, len(CAUSE_SETS), len(self.log_odds)), -np.inf)
        for number, some in enumerate(CAUSE_SETS):
            if OEDEMA in some and not self.is_paired:
                continue
            last = some not in extended
            here = found[some] = found[some[:-1]].eliminate_unknowns(some[-1], last) if some else rigid
            evidence[..., number, 0] = here.log_evidence
        pressed = [number for number, some in enumerate(CAUSE_SETS) if some in PLACE_SETS and some in found]
        evidence[..., pressed, 1:] = np.moveaxis(
            add_place_unknowns([found[CAUSE_SETS[number]] for number in pressed]), 0, -2
        )
        return self.log_odds + evidence.swapaxes(1, 2).reshape(-1, len(self.log_odds)) / POSTERIOR.evidence_divisor

    def _build_equations(self) -> NormalEquations:
        """Build the normal equations of all unknowns for each skull, each divided by its prior standard deviation."""
        shared, products = self.prior.tables, self.system.products
        skulls, places = len(shared.rows), shared.place_rows
        rows = np.concatenate([shared.rows, np.tile(self._rigid_rows, (skulls, 1))], axis=1)
        size = np.concatenate([self.motion_size * shared.deviations, np.ones((skulls, 6))], axis=1)
        # Unknowns of each place, followed by the data.
        beside = np.concatenate([places, np.full((*places.shape[:2], 1), len(products) - 1)], axis=2)
        beside_size = np.append(np.full(places.shape[2], self.motion_size), 1.0)
        columns = np.concatenate([rows, beside.reshape(skulls, -1)], axis=1)
        wide = np.concatenate([size, np.tile(beside_size, (skulls, places.shape[1]))], axis=1)
        table = products[rows[:, :, None], columns[:, None]] * size[:, :, None] * wide[:, None]
        table[..., *np.diag_indices(rows.shape[1])] += 1.0
        place = products[places[..., None], beside[:, :, None]] * self.motion_size * beside_size
        place[..., *np.diag_indices(places.shape[2])] += 1.0
        return NormalEquations(np.append(shared.kind, np.full(6, RIGID_KIND)), table, place, np.zeros(skulls))

    @property
    def _rigid_rows(self) -> np.ndarray:
        """Row numbers (6,) of the rigid error's components."""
        return np.arange(-7, -1) + len(self.system.products)

    def compute_posterior(self, hypothesis: Hypothesis, place_rows: np.ndarray, probability: float) -> HypothesisResult:
        """Compute the posterior of a hypothesis, including the shapes `place_rows` (q,) of a tool on one place."""
        own = np.concatenate([hypothesis.rows, self._rigid_rows, place_rows])
        size = np.full(len(own), self.motion_size)
        size[: len(hypothesis.rows)] *= hypothesis.deviations
        size[len(hypothesis.rows) : len(own) - len(place_rows)] = min(hypothesis.rigid_ratio, self.slip_ratio)
        inner = self.system.products[own[:, None], own] * size * size[:, None]
        inner.flat[:: len(own) + 1] += 1.0
        lower = np.linalg.cholesky(inner)
        mean = size * potrs(lower.T, size * self.system.products[-1, own])[0]
        return HypothesisResult(probability, own, mean, size, lower)


def build_observed_prior(prior: MotionPrior, evidence: Evidence, tips: np.ndarray = NO_TIPS) -> ObservedPrior:
    """Whiten a prior at the points of evidence; `tips` (k, 3) [m] are tool tips that touch the cortex."""
    seen = float(np.sqrt((evidence.motion**2).sum() / len(np.unique(evidence.point))))
    # A motion and a rigid error may cancel, so that the observation is small; and noise hides smaller motions.
    scale = 1e3 * max(float(np.hypot(seen, np.sqrt(3.0) * evidence.shift_sigma)), float(np.median(evidence.sigma)))
    return ObservedPrior(
        prior,
        scale,
        whiten_system(prior, evidence, seen),
        prior.compute_log_odds(tips),
        evidence.slip_ratio,
        evidence.is_paired,
    )


def condition_prior(
    prior: MotionPrior, evidence: Evidence, tips: np.ndarray = NO_TIPS, allow_slip: bool = False
) -> Posterior:
    """Condition a prior on evidence without outliers; `tips` (k, 3) [m] are tool tips that touch the cortex.

    The rigid error has the reported size; if `allow_slip`, it may also be that of a slipped registration.

    Raises
    ------
    InputError
        Fewer points than `PosteriorSettings.min_inliers` agree on a motion.
    """
    kept, point = np.ones(len(evidence), bool), evidence.point
    while True:
        some = evidence.select(kept)
        seen = build_observed_prior(prior, some, tips)
        answers = seen.compute_posteriors(allow_slip)
        odd = _compute_outlier_distances(seen.system, answers[0], some.point)
        excess = odd / chdtri(np.unique(some.point, return_counts=True)[1], POSTERIOR.outlier_significance)
        if excess.max() <= 1.0 or len(excess) <= POSTERIOR.min_inliers:
            break
        kept &= ~np.isin(point, np.unique(some.point)[excess >= max(1.0, 0.5 * excess.max())])
        if len(np.unique(point[kept])) < POSTERIOR.min_inliers:
            raise InputError(
                f"of {len(np.unique(point))} points fewer than {POSTERIOR.min_inliers} agree on a motion: check that "
                "each has its own motion. If they are less sure, raise sigma."
            )
    unknown = np.zeros(len(prior.kind) + 6)
    for result in answers:
        unknown[result.rows] += result.probability * result.mean
    outliers = np.setdiff1d(point, some.point)
    return Posterior(
        some, answers, unknown, float(odd.sum() / len(some)), outliers, seen.slip_log_odds, seen.motion_evidence
    )


def _compute_outlier_distances(rows: WhitenedSystem, result: HypothesisResult, point_numbers: np.ndarray) -> np.ndarray:
    """Compute squared Mahalanobis distances (n,) of points from leave-one-out predictions under one hypothesis."""
    data = len(rows.products) - 1
    precise = rows.apply_precision(np.append(result.rows, data))
    known = precise[:, :-1] @ result.root.T
    gain = precise[:, -1] - precise[:, :-1] @ result.mean
    number = np.unique(point_numbers, return_inverse=True)[1]
    order, count = np.argsort(number, kind="stable"), np.bincount(number)
    found, first = np.empty(len(count)), np.cumsum(count) - count
    for size in np.unique(count):
        some = np.flatnonzero(count == size)
        table = order[first[some][:, None] + np.arange(size)]
        inverse = rows.whitening.compute_precision(table) - known[table] @ known[table].transpose(0, 2, 1)
        own = gain[table]
        found[some] = np.einsum("ni,ni->n", own, np.linalg.solve(inverse, own[..., None])[..., 0])
    return found

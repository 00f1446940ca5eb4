"""Likelihood of a frame for each candidate tissue: Gaussian in the sizes of its motions and in the errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import logsumexp

from sim.effects import SKULLS
from sim.errors import InputError

from ..array_functions import compute_squared_distances
from ..locating.causes import DRAINAGE
from ..locating.evidence import Evidence, compute_correlation
from ..locating.locator import Locator
from ..locating.prior import MotionPrior
from .observed_frame import ObservedFrame
from .responses import SOLVED_SKULLS, Responses


@dataclass(frozen=True)
class LikelihoodSettings:
    """Settings of the likelihood of a frame."""

    # Model error of linear tissue as a share of a point's motion, in the independent and in the correlated part.
    model_error_share: float = 0.05
    model_error_length: float = 10e-3  # Correlation length of the correlated part [m].
    min_motion_share: float = 0.1  # Lower bound of a point's motion in the model error, relative to the mean motion.
    # Candidate sizes of motions, relative to the observation.
    motion_sizes: tuple[float, float, float] = (0.3, 1.0, 3.0)
    evidence_divisor: float = 2.0  # Divisor of the log evidence of drained fluid.
    tool_evidence_divisor: float = 8.0  # Divisor of the log evidence of tools, whose dents are nonlinear.


LIKELIHOOD = LikelihoodSettings()


def compute_drainage_likelihood(drainages: Responses, prior: MotionPrior, evidence: Evidence) -> np.ndarray:
    """Compute the log-likelihood (skulls, poissons, ratios) of a frame in which fluid has drained."""
    lower, seen = factorise_errors(evidence)
    rows = {name: predict_observation(drainages, name, evidence) for name in SOLVED_SKULLS}
    own = (prior.kind == DRAINAGE) & (prior.skull == list(SKULLS).index("contact"))
    lets_go = prior.project_shapes(*evidence.weights)[:, own].T
    size = np.mean([_compute_size(each) for each in rows.values()])
    found = {name: _compute_log_evidence(each / size, evidence, lower, seen) for name, each in rows.items()}
    found["contact"] = _compute_log_evidence((lets_go / _compute_size(lets_go))[None, None], evidence, lower, seen)
    shape = found[SOLVED_SKULLS[0]].shape
    return np.stack([np.broadcast_to(found[name], shape) for name in SKULLS]) / LIKELIHOOD.evidence_divisor


def compute_pressing_likelihood(presses: Responses, response_columns: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Compute the log-likelihood (skulls, 1, 1) of a frame with tools, given `response_columns` (k,) of the responses.

    Dents by tools determine only the skull model. Their information on Poisson's ratio and stiffness ratio is mostly
    nonlinear stiffening, which linear responses lack.
    """
    lower, seen = factorise_errors(evidence)
    rows = {name: predict_observation(presses, name, evidence)[:, :, response_columns] for name in SOLVED_SKULLS}
    size = np.mean([_compute_size(each) for each in rows.values()])
    found = {name: _compute_log_evidence(each / size, evidence, lower, seen) for name, each in rows.items()}
    found = {name: logsumexp(each) - np.log(each.size) for name, each in found.items()}
    found["contact"] = found["slide"]
    return np.array([found[name] for name in SKULLS])[:, None, None] / LIKELIHOOD.tool_evidence_divisor


def predict_observation(responses: Responses, skull: str, evidence: Evidence) -> np.ndarray:
    """Predict the m observed displacement components (Poisson's ratios, stiffness ratios, loads, m) [m]."""
    column = np.searchsorted(responses.nodes, evidence.location.vertices)
    motion = responses.motion[skull][..., column, :]
    return np.einsum("prlmki,mk,mi->prlm", motion, evidence.location.weights, evidence.axis, optimize=True)


def _compute_size(rows: np.ndarray) -> float:
    return float(np.sqrt((rows**2).sum(axis=-2).mean()))


def factorise_errors(evidence: Evidence, expected_motion: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Compute the Cholesky factor (m, m) of the total error covariance, and the root mean square observation [m].

    The model error is a share of `expected_motion` (m,) [m]; None: of the observed motion, which includes noise. Points
    with larger apparent motion then have less weight, so that motions are underestimated.
    """
    value = evidence.motion if expected_motion is None else expected_motion
    length = np.sqrt(np.bincount(evidence.point, value**2))[evidence.point]
    seen = float(np.sqrt((value**2).mean()))
    off = LIKELIHOOD.model_error_share * np.maximum(length, LIKELIHOOD.min_motion_share * np.sqrt(3.0) * seen)
    square = compute_squared_distances(evidence.positions, evidence.positions)
    correlation = compute_correlation(square, LIKELIHOOD.model_error_length)
    noise = evidence.compute_covariance() + np.outer(off, off) * correlation * (evidence.axis @ evidence.axis.T)
    noise[np.diag_indices(len(noise))] += off**2
    rigid = evidence.rigid_jacobian * evidence.rigid_scale
    return cholesky(noise + rigid @ rigid.T, lower=True), max(seen, 1e-6)


def whiten_columns(cholesky: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Whiten columns (m,) or (m, k) by errors whose covariance has the Cholesky factor `cholesky` (m, m)."""
    return solve_triangular(cholesky, columns, lower=True, check_finite=False)


def _compute_log_evidence(rows: np.ndarray, evidence: Evidence, cholesky: np.ndarray, scale: float) -> np.ndarray:
    """Compute log evidence (poissons, ratios) of motions (poissons, ratios, loads, m), scaled to a mean size of 1."""
    motion = scale * whiten_columns(cholesky, rows.reshape(-1, rows.shape[-1]).T).T.reshape(rows.shape)
    gram, pull = motion @ motion.transpose(0, 1, 3, 2), motion @ whiten_columns(cholesky, evidence.motion)
    logs = []
    for times in LIKELIHOOD.motion_sizes:
        root = np.linalg.cholesky(np.eye(gram.shape[-1]) + times**2 * gram)
        half = np.linalg.solve(root, times * pull[..., None])[..., 0]
        logs.append(0.5 * (half**2).sum(axis=-1) - np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1))
    return logsumexp(logs, axis=0) - np.log(len(LIKELIHOOD.motion_sizes))


def find_unsupported_points(locator: Locator, frames: Sequence[ObservedFrame]) -> tuple[np.ndarray, ...]:
    """Return for each frame the indices (k,) of the points that `Locator.locate` rejects as outliers.

    Raises
    ------
    InputError
        No cause explains a frame, or more than a third of its points are rejected.
    """
    found = []
    for number, frame in enumerate(frames, start=1):
        try:
            found.append(locator.locate(frame.observation).outliers)
        except InputError as error:
            raise InputError(f"frame {number}: {error}") from error
    return tuple(found)


def remove_points(frames: Sequence[ObservedFrame], point_numbers: Sequence[np.ndarray]) -> list[ObservedFrame]:
    """Remove the points with given indices (k,) from each frame; points must have correspondences."""
    return [
        _remove_points(frame, numbers) if len(numbers) else frame
        for frame, numbers in zip(frames, point_numbers, strict=True)
    ]


def _remove_points(frame: ObservedFrame, point_numbers: np.ndarray) -> ObservedFrame:
    seen = frame.observation
    assert seen.rest is not None
    kept = np.delete(np.arange(len(seen.now)), point_numbers)
    sigma = None if seen.sigma is None else seen.sigma[kept]
    return replace(frame, observation=replace(seen, now=seen.now[kept], rest=seen.rest[kept], sigma=sigma))

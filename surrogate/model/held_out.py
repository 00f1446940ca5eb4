"""Errors of a model on held-out cortex regions, and the decision that a model needs FEM fallback."""

from dataclasses import dataclass

import numpy as np

MAX_VERTEX_ERROR = 0.2e-3
"""Limit [m] of the maximum vertex error of the tumour (95th percentile); above it FEM replaces the model."""
VERTEX_ERROR_LIMITS = (MAX_VERTEX_ERROR, 0.1e-3, 0.05e-3, 0.02e-3, 0.01e-3, 0.0)
"""Candidate limits [m]; a model gets the largest one that satisfies `MAX_MEAN_ERROR` and `MAX_P999_ERROR`.

With the limit 0, FEM solves all loads.
"""
MAX_MEAN_ERROR = 0.01  # Largest mean error of a model without FEM fallback, as a share of the motion.
MAX_P999_ERROR = 0.2e-3  # Largest 99.9th percentile of the vertex errors of a model without FEM fallback [m].
MIN_LOADS_FOR_P999 = 1000
"""Minimum number of loads to compute a 99.9th percentile."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on held-out cortex, of a model alone and with FEM fallback.

    Parameters
    ----------
    mean, guarded
        Mean over loads and tumour vertices of (error / mean motion of the load), of the model alone and of `Guarded`.
        Loads solved by FEM count as exact.
    p999
        99.9th percentile [m] over loads and vertices of the model's errors; None for fewer than `MIN_LOADS_FOR_P999`
        loads.
    solved
        Share of the held-out loads that `Guarded` solves by FEM.
    limit
        Limit [m] chosen from `VERTEX_ERROR_LIMITS`; older files use the first.
    """

    mean: float
    guarded: float
    p999: float | None
    solved: float
    limit: float = MAX_VERTEX_ERROR

    @property
    def is_sufficient(self) -> bool:
        """True if the model alone is accurate enough to be used without FEM fallback."""
        return _is_enough(self.mean, self.p999)

    def __str__(self) -> str:
        """Return a description of the errors, for reports."""
        behind = (
            f"with FEM for {100 * self.solved:.0f} % of the loads (bound above "
            f"{1e3 * self.limit:g} mm) {100 * self.guarded:.2f} %"
        )
        return f"mean error {100 * self.mean:.2f} % of the motion alone; {behind}"


@dataclass(frozen=True)
class ReportedErrors:
    """Reported errors of a model on held-out cortex, with `bound` [m] and `held_out` as in `Learned`."""

    bound: float
    held_out: HeldOutErrors | None

    @property
    def is_weak(self) -> bool:
        """True if the model needs FEM fallback: decided by `held_out`, or by `bound` if there is none."""
        return not (self.bound <= MAX_VERTEX_ERROR if self.held_out is None else self.held_out.is_sufficient)

    def __str__(self) -> str:
        """Return a description of the errors and their limits."""
        if self.held_out is None:
            return (
                f"maximum error up to {1e3 * self.bound:.2g} mm in 95 % of loads (limit {1e3 * MAX_VERTEX_ERROR:g} mm)"
            )
        mean = f"mean error {100 * self.held_out.mean:.2g} % of the motion (limit {100 * MAX_MEAN_ERROR:g} %)"
        if self.held_out.p999 is None:
            return mean
        return f"{mean}; 99.9th percentile {1e3 * self.held_out.p999:.2g} mm (limit {1e3 * MAX_P999_ERROR:g} mm)"


def find_fem_fallback(bound: np.ndarray, is_outside: np.ndarray, limit: float) -> np.ndarray:
    """Return the mask (B,) of loads that FEM must solve: no bound or a bound above the limit, or `is_outside`.

    `bound` (B,) and `limit` are in metres. `is_outside` (B,) is True for loads outside the training range.
    """
    return ~(bound <= limit) | is_outside


def measure_held_out(error: np.ndarray, motion: np.ndarray, bound: np.ndarray, is_outside: np.ndarray) -> HeldOutErrors:
    """Compute the errors on B held-out loads, and choose the largest sufficient limit of `VERTEX_ERROR_LIMITS`.

    A limit is sufficient if the model with FEM fallback satisfies `MAX_MEAN_ERROR` and `MAX_P999_ERROR`.

    Parameters
    ----------
    error
        Error relative to FEM (B, n) [m], at the tumour's vertices.
    motion
        Mean displacement (B,) [m] of the tumour's vertices.
    bound
        Bound (B,) [m] of the maximum vertex error, with probability 0.95.
    is_outside
        Mask (B,) of loads outside the training range.
    """
    share, left, solved, limit = error.mean(axis=1) / motion, 0.0, is_outside, MAX_VERTEX_ERROR
    for limit in VERTEX_ERROR_LIMITS:
        solved = find_fem_fallback(bound, is_outside, limit)
        left = float(np.where(solved, 0.0, share).mean())
        if _is_enough(left, _compute_p999(np.where(solved[:, None], 0.0, error))):
            break
    return HeldOutErrors(float(share.mean()), left, _compute_p999(error), float(solved.mean()), limit)


def _compute_p999(distance: np.ndarray) -> float | None:
    """Compute the 99.9th percentile of errors (B, n) [m]; None for fewer than `MIN_LOADS_FOR_P999` loads."""
    return float(np.percentile(distance, 99.9)) if len(distance) >= MIN_LOADS_FOR_P999 else None


def _is_enough(mean: float, p999: float | None) -> bool:
    return mean <= MAX_MEAN_ERROR and (p999 is None or p999 <= MAX_P999_ERROR)

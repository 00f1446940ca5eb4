"""Limits of steps under tools: backtracking, proximal term, and hand-over to Newton."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ContactLimits:
    """Limits of steps under tools: backtracking, proximal term, and hand-over to Newton.

    Parameters
    ----------
    forcing, tolerance_factor
        Relative tolerance of the tools' forces: fraction of the relative residual, or of the tolerance if larger.
    residual_factor, min_good_step
        A good step leaves at most this fraction of the residual, and is longer than this fraction of the direction.
    patience
        Number of steps in a row that are not good, after which Newton takes over.
    reset_length
        Step length below which backtracking ends and the model is reset, if there is one.
    accepted_length
        Step length at or below which a step is accepted without test.
    stale_factor
        Remaining fraction of the residual above which the model of strained tissue is recomputed.
    min_curvature
        [J] Product s . y at or below which a curvature pair is round-off, and not stored.
    proximal, growth, max_failures
        First proximal coefficient; factor of its growth and reduction; failures in a row until the model is reset.
    ended_fraction
        Fraction of ended load cases at which they leave the batch: this copies all arrays.
    """

    forcing: float = 0.03
    tolerance_factor: float = 0.1
    residual_factor: float = 0.6
    min_good_step: float = 0.5
    patience: int = 10
    reset_length: float = 0.1
    accepted_length: float = 1e-3
    stale_factor: float = 0.5
    min_curvature: float = 1e-60
    proximal: float = 0.3
    growth: float = 3.0
    max_failures: int = 5
    ended_fraction: float = 0.125


CONTACT_LIMITS = ContactLimits()  # Default.

"""Limits of steps under tools: backtracking, proximal term, and hand-over to Newton."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ContactLimits:
    """Limits of contact steps: backtracking, proximal term, and change to Newton's method.

    Parameters
    ----------
    forcing, tolerance_factor
        Relative tolerance of the tool forces: the larger of these fractions of the relative residual and the tolerance.
    residual_factor, min_good_step
        A step is good if it leaves at most this fraction of the residual and exceeds this fraction of the direction.
    patience
        Number of successive steps that are not good, after which Newton's method continues.
    reset_length
        Step length below which backtracking ends and the model, if any, is reset.
    accepted_length
        Step length at or below which a step is accepted without a test.
    stale_factor
        Remaining fraction of the residual above which the model of strained tissue is recomputed.
    min_curvature
        Product s . y [J] at or below which a curvature pair is round-off and not stored.
    proximal, proximal_growth, max_failures
        First proximal coefficient; factor of its growth and reduction; successive failures until the model is reset.
    max_ended_fraction
        Fraction of ended load cases at which these are removed from the batch, which copies all arrays.
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
    proximal_growth: float = 3.0
    max_failures: int = 5
    max_ended_fraction: float = 0.125


CONTACT_LIMITS = ContactLimits()  # Default.

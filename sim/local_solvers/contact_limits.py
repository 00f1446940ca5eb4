"""Limits of steps under tools: backtracking, proximal term, and hand-over to Newton."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ContactLimits:
    """Limits of steps under tools: backtracking, proximal term, and hand-over to Newton.

    Parameters
    ----------
    forcing, enough
        Relative tolerance of the tools' forces: fraction of the relative residual, or of the tolerance if larger.
    left, long
        A good step leaves at most this fraction of the residual, and is longer than this fraction of the direction.
    patience
        Number of steps in a row that are not good, after which Newton takes over.
    shortest
        Step length below which backtracking ends and the model is reset, if there is one.
    least
        Step length at or below which a step is accepted without test.
    stale
        Remaining fraction of the residual above which the model of strained tissue is recomputed.
    felt
        [J] Product s . y at or below which a curvature pair is round-off, and not stored.
    drag, growth, times
        First proximal coefficient; factor of its growth and reduction; failures in a row until the model is reset.
    crowd
        Fraction of ended load cases at which they leave the batch: this copies all arrays.
    """

    forcing: float = 0.03
    enough: float = 0.1
    left: float = 0.6
    long: float = 0.5
    patience: int = 10
    shortest: float = 0.1
    least: float = 1e-3
    stale: float = 0.5
    felt: float = 1e-60
    drag: float = 0.3
    growth: float = 3.0
    times: int = 5
    crowd: float = 0.125


CONTACT_LIMITS = ContactLimits()  # Default.

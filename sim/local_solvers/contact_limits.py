"""When steps under tools are cut, damped by a drag, and left to Newton."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ContactLimits:
    """When steps are cut, damped by a drag, and left to Newton.

    Parameters
    ----------
    forcing, enough
        Tools' forces are exact to this share of the whole residual, or of the tolerance.
    left, long
        A step does well that leaves so much of the free force, and is not cut shorter than this.
    patience
        After so many in a row that do not, Newton goes on.
    shortest
        A step that is cut to less than this is not taken if what was learnt may have misled it.
    least
        A step so short is taken as it is.
    stale
        A model of strained tissue that left more than this share of the free force is made anew.
    felt
        [J] A step that is worth less is round-off, and nothing is learnt from it.
    drag, growth, times
        The first drag that is tried where one is wanted, by how much it grows and shrinks, and how often it grows.
    crowd
        Columns that have ended leave the batch when they are this share of it: each time everything is copied.
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


CONTACT = ContactLimits()

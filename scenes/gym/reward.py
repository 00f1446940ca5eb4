"""What a step is worth."""

from __future__ import annotations

from dataclasses import dataclass

STEP, OVER_LIMIT, DONE, ENDED = 0.01, 0.5, 10.0, -10.0
"""A step costs, a step over a limit costs, success brings, and the end at a limit brings so much."""
SHARE = 3.0
"""What each share that is cut brings."""
FAR, NEAR = 0.03, 0.01
"""Distances [m] beyond which all count alike, and that count 1."""


@dataclass(frozen=True)
class Judged:
    """How far an episode is from its goal.

    Parameters
    ----------
    away
        Of the tool from its place [m].
    off
        Of what is reached from what is asked for, as a share of that.
    cut
        Shares of the tumour that are cut.
    load
        The force, or the pressure, as a share of its limit: the greater of both.
    """

    away: float
    off: float
    cut: int
    load: float

    @property
    def potential(self) -> float:
        """What a policy climbs: its differences are rewarded."""
        return SHARE * self.cut - min(self.away, FAR) / NEAR - min(self.off, 1.0)


def earned(before: Judged, now: Judged, success: bool, ended: bool) -> float:
    """The reward of a step from one state to the next; `ended`: at a limit, without success."""
    reward = now.potential - before.potential - STEP
    if now.load > 1.0:
        reward -= OVER_LIMIT
    return float(reward + (DONE if success else ENDED if ended else 0.0))

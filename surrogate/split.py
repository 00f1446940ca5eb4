"""Which loads are kept for the test: whole discs of the cortex, so that no model has seen a neighbour of its test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError

from .patch import Patch, nearest
from .sampling import spread

FEWEST, MOST, SHARE = 6, 200, 0.15
RADII = (6e-3, 5e-3, 4e-3, 3e-3, 2e-3, 1e-3)


@dataclass(frozen=True, eq=False)
class Split:
    """Discs left out of the training.

    Parameters
    ----------
    centres
        (k, 3) [m].
    radius
        Of each disc [m].
    disc
        (B,) number of the disc that a load's point lies in, -1 for the training loads.
    share
        Part of the patch's area that the discs cover.
    """

    centres: np.ndarray
    radius: float
    disc: np.ndarray
    share: float

    @property
    def test(self) -> np.ndarray:
        """(B,) bool."""
        return self.disc >= 0

    def summary(self) -> str:
        """What was left out, in one line for people (mm)."""
        return (
            f"{len(self.centres)} discs of {1e3 * self.radius:g} mm radius ({100 * self.share:.0f} % of the open "
            f"cortex) left out: {int(self.test.sum())} loads to test, {int((~self.test).sum())} to learn from"
        )


def leave_discs_out(points: np.ndarray, patch: Patch) -> Split:
    """Discs of 6 mm radius round load points (B, 3) [m] far from each other: at least 6, at least 15 % of the patch.

    The discs shrink, at a small craniotomy, until at most half of the loads are left out. Loads at few positions (the
    preset `seed`) are left out by position either way.

    Raises
    ------
    InputError
        Fewer than seven positions.
    """
    order = spread(points, MOST) if len(points) else np.zeros(0, int)
    if len(order) < FEWEST + 1:
        raise InputError(
            f"the loads that converged have {len(order)} positions, too few to leave {FEWEST} discs out: simulate more."
        )
    split = _discs(points, order, patch, RADII[0])
    for radius in RADII[1:]:
        if split.test.mean() <= 0.5:
            break
        split = _discs(points, order, patch, radius)
    return split


def _discs(points: np.ndarray, order: np.ndarray, patch: Patch, radius: float) -> Split:
    count = FEWEST
    while patch.covered(points[order[:count]], radius) < SHARE and count < len(order) - 1:
        count += 1
    centres = points[order[:count]]
    which, distance = nearest(points, centres)
    return Split(centres, radius, np.where(distance <= radius, which, -1), patch.covered(centres, radius))

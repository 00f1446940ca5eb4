"""Which loads are kept for the test: whole discs of the cortex, so that no model has seen a neighbour of its test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError

from .cortex_patch import Patch, nearest
from .tool_loads import spread

FEWEST, MOST, SHARE = 6, 200, 0.15
# One load in so many, and at most so many, is kept apart from every split, to calibrate bounds.
APART, MOST_APART = 4, 2000
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
        (B,) number of the disc that a load's point lies in, -1 for the training loads, -2 for those of no use.
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

    @property
    def train(self) -> np.ndarray:
        """(B,) bool."""
        return self.disc == -1

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3) [m] lie in a disc: a scored model may be given nothing there. (n,) bool."""
        return nearest(points, self.centres)[1] <= self.radius

    def summary(self) -> str:
        """What was left out, in one line for people (mm)."""
        return (
            f"{len(self.centres)} discs of {1e3 * self.radius:g} mm radius ({100 * self.share:.0f} % of the open "
            f"cortex) left out: {int(self.test.sum())} loads to test, {int(self.train.sum())} to train on"
        )


def leave_discs_out(points: np.ndarray, patch: Patch) -> Split:
    """Discs of 6 mm radius round load points (B, 3) [m] far from each other: at least 6, and 15 % of the patch.

    No disc beyond the sixth is taken if it would leave fewer than half of the loads to train on. At a small
    craniotomy, where six discs take more than half, the discs shrink, as far as that helps. Six of the few positions of
    the preset `seed` are more than half in any case.

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
    splits = [_discs(points, points[order], patch, radius) for radius in RADII]
    fewest = min(splits, key=lambda split: split.test.mean())
    return next((split for split in splits if split.test.mean() <= 0.5), fewest)


def _discs(points: np.ndarray, candidates: np.ndarray, patch: Patch, radius: float) -> Split:
    split = _split(points, candidates[:FEWEST], patch, radius)
    for count in range(FEWEST + 1, len(candidates)):
        if split.share >= SHARE:
            break
        more = _split(points, candidates[:count], patch, radius)
        if more.test.mean() > 0.5:
            break
        split = more
    return split


def _split(points: np.ndarray, centres: np.ndarray, patch: Patch, radius: float) -> Split:
    which, distance = nearest(points, centres)
    return Split(centres, radius, np.where(distance <= radius, which, -1), patch.covered(centres, radius))

"""Which directions are kept for the test: whole sectors round the cortex's normal, so that no model has seen them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Pushed

from .cortex_patch import Patch
from .disc_split import Split
from .encode import directions
from .tool_loads import across

# Of so many sectors two are left out, which lie opposite; a force within so many degrees of the normal lies in none.
SECTORS, UPRIGHT = 8, 10.0


@dataclass(frozen=True, eq=False)
class Sectors(Split):
    """Sectors of tangential direction left out.

    As `Split`, but `centres` are unit directions (k, 3), and `radius` is half the width of a sector [rad]. `disc` is
    the number of the sector that a load's force lies in, and `share` a part of the circle.
    """

    def covers(self, points: np.ndarray) -> np.ndarray:
        """No place is left out, but directions are. (n,) bool."""
        return np.zeros(len(points), bool)

    def summary(self) -> str:
        """What was left out, in one line for people (degrees)."""
        return (
            f"{len(self.centres)} sectors of {2.0 * np.degrees(self.radius):g} degrees round the cortex's normal left "
            f"out: {int(self.test.sum())} loads to test, {int(self.train.sum())} to train on"
        )


def leave_sectors_out(pushed: Pushed, patch: Patch) -> Sectors:
    """Two opposite sectors of 45 degrees of the direction in which forces point along the open cortex.

    Forces within 10 degrees of the mean inward normal are learnt from: they hardly point along it.

    Raises
    ------
    InputError
        No load in the sectors, or none outside.
    """
    axis = patch.inward.mean(axis=0)
    axis /= np.linalg.norm(axis)
    first, second = (side[0] for side in across(axis[None]))
    force = directions(pushed)[1]
    angle = np.arctan2(force @ second, force @ first) % (2.0 * np.pi)
    # The first sector lies round `first`, so that a lattice of directions which begins there is not cut at its rim.
    sector = np.rint(angle * SECTORS / (2.0 * np.pi)).astype(int) % SECTORS
    tilted = force @ axis < np.cos(np.radians(UPRIGHT))
    left_out = tilted & (sector % (SECTORS // 2) == 0)
    if not left_out.any() or left_out.all():
        raise InputError(
            f"of {len(force)} loads {int(left_out.sum())} point into the directions to leave out: simulate more, or "
            "loads of more directions."
        )
    return Sectors(
        np.stack([first, -first]), np.pi / SECTORS, np.where(left_out, sector // (SECTORS // 2), -1), 2.0 / SECTORS
    )

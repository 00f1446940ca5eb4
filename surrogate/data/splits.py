"""Splits of a data set's loads: by direction of the force, and by disc of the cortex."""

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Pushed

from .cortex_patch import Patch, find_nearest
from .encode import split_forces
from .tool_loads import find_perpendiculars, select_spread

CALIBRATION_STRIDE = 4  # One of this many loads is set aside from every split to calibrate bounds.
MAX_CALIBRATION_LOADS = 2000  # Maximum number of loads set aside to calibrate bounds.
SECTOR_COUNT = 8  # Number of sectors, of which two opposite ones are held out.
MIN_SECTOR_ANGLE = 10.0  # Angle to the normal below which a force is in no sector [deg].


@dataclass(frozen=True)
class DiscSettings:
    """Settings of `hold_out_discs`."""

    min_discs: int = 6  # Minimum number of held-out discs.
    max_positions: int = 200  # Maximum number of candidate positions for the discs' centres.
    held_out_share: float = 0.15  # Share of the patch's area that the discs should cover.
    # Candidate radii of the discs, the default first [m].
    disc_radii: tuple[float, ...] = (6e-3, 5e-3, 4e-3, 3e-3, 2e-3, 1e-3)


@dataclass(frozen=True, eq=False)
class DiscSplit:
    """Held-out discs of the cortex.

    Parameters
    ----------
    centres
        Centres of the discs (k, 3) [m].
    radius
        Radius of each disc [m].
    disc_index
        Number (B,) of the disc that contains a load's point, -1 for the training loads, -2 for unused ones.
    area_share
        Share of the patch's area that the discs cover.
    """

    centres: np.ndarray
    radius: float
    disc_index: np.ndarray
    area_share: float

    @property
    def test_mask(self) -> np.ndarray:
        """(B,) bool: mask of the test loads."""
        return self.disc_index >= 0

    @property
    def training_mask(self) -> np.ndarray:
        """(B,) bool: mask of the training loads."""
        return self.disc_index == -1

    def is_covered(self, points: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of points (n, 3) [m] in a disc, where a scored model must not be given any data."""
        return find_nearest(points, self.centres)[1] <= self.radius

    def summarise(self) -> str:
        """Describe the held-out loads in one line [mm]."""
        return (
            f"{len(self.centres)} discs of {1e3 * self.radius:g} mm radius ({100 * self.area_share:.0f} % of the open "
            f"cortex) left out: {int(self.test_mask.sum())} loads to test, {int(self.training_mask.sum())} to train on"
        )


def hold_out_discs(points: np.ndarray, patch: Patch, settings: DiscSettings = DiscSettings()) -> DiscSplit:
    """Hold out discs of 6 mm radius round distant load points (B, 3) [m]: at least 6, and 15 % of the patch.

    No disc beyond the sixth is taken if it would leave fewer than half of the loads to train on. At a small craniotomy,
    where six discs take more than half, the discs shrink, as far as that helps. Six of the few positions of the preset
    `seed` are more than half in any case.

    Raises
    ------
    InputError
        Fewer than seven positions.
    """
    order = select_spread(points, settings.max_positions) if len(points) else np.zeros(0, int)
    if len(order) < settings.min_discs + 1:
        raise InputError(
            f"the loads that converged have {len(order)} positions, too few to leave {settings.min_discs} discs out: "
            "simulate more."
        )
    splits = [_build_discs(points, points[order], patch, radius, settings) for radius in settings.disc_radii]
    fewest = min(splits, key=lambda split: split.test_mask.mean())
    return next((split for split in splits if split.test_mask.mean() <= 0.5), fewest)


def _build_discs(
    points: np.ndarray, candidates: np.ndarray, patch: Patch, radius: float, settings: DiscSettings
) -> DiscSplit:
    split = _split(points, candidates[: settings.min_discs], patch, radius)
    for count in range(settings.min_discs + 1, len(candidates)):
        if split.area_share >= settings.held_out_share:
            break
        more = _split(points, candidates[:count], patch, radius)
        if more.test_mask.mean() > 0.5:
            break
        split = more
    return split


def _split(points: np.ndarray, centres: np.ndarray, patch: Patch, radius: float) -> DiscSplit:
    which, distance = find_nearest(points, centres)
    return DiscSplit(centres, radius, np.where(distance <= radius, which, -1), patch.compute_coverage(centres, radius))


@dataclass(frozen=True, eq=False)
class SectorSplit(DiscSplit):
    """Held-out sectors of tangential direction.

    As `DiscSplit`, but `centres` are unit directions (k, 3), and `radius` is half the width of a sector [rad]. `disc`
    is the number of the sector that a load's force is in, and `share` a part of the circle.
    """

    def is_covered(self, points: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of held-out points: none, as directions are held out."""
        return np.zeros(len(points), bool)

    def summarise(self) -> str:
        """Describe the held-out loads in one line [degrees]."""
        return (
            f"{len(self.centres)} sectors of {2.0 * np.degrees(self.radius):g} degrees round the cortex's normal left "
            f"out: {int(self.test_mask.sum())} loads to test, {int(self.training_mask.sum())} to train on"
        )


def hold_out_sectors(pushes: Pushed, patch: Patch) -> SectorSplit:
    """Hold out two opposite sectors of 45 degrees of the tangential direction of forces on the open cortex.

    Forces within 10 degrees of the mean inward normal are training loads: they have almost no tangential direction.

    Raises
    ------
    InputError
        No load in the sectors, or none outside.
    """
    axis = patch.normals.mean(axis=0)
    axis /= np.linalg.norm(axis)
    first, second = (side[0] for side in find_perpendiculars(axis[None]))
    force = split_forces(pushes)[1]
    angle = np.arctan2(force @ second, force @ first) % (2.0 * np.pi)
    # The first sector is centred on `first`, so that a lattice of directions starting there is not cut at its edge.
    sector = np.rint(angle * SECTOR_COUNT / (2.0 * np.pi)).astype(int) % SECTOR_COUNT
    tilted = force @ axis < np.cos(np.radians(MIN_SECTOR_ANGLE))
    held_out = tilted & (sector % (SECTOR_COUNT // 2) == 0)
    if not held_out.any() or held_out.all():
        raise InputError(
            f"of {len(force)} loads {int(held_out.sum())} point into the directions to leave out: simulate more, or "
            "loads of more directions."
        )
    disc = np.where(held_out, sector // (SECTOR_COUNT // 2), -1)
    return SectorSplit(np.stack([first, -first]), np.pi / SECTOR_COUNT, disc, 2.0 / SECTOR_COUNT)

"""Splits of a data set's loads into training and test loads, by disc of the cortex or by direction of the force."""

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Pushed

from .cortex_patch import Patch, find_nearest
from .encode import split_forces
from .tool_loads import find_perpendiculars, pick_far_points

CALIBRATION_STRIDE = 4  # One in this many loads is set aside, before any split, to calibrate bounds.
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
    """Split of loads by held-out discs of the cortex.

    Parameters
    ----------
    centres
        Centres of the discs (k, 3) [m].
    radius
        Radius of each disc [m].
    disc_index
        Index (B,) of the disc that contains a load's point; -1 for training loads, -2 for unused loads.
    area_share
        Share of the patch's area that the discs cover.
    """

    centres: np.ndarray
    radius: float
    disc_index: np.ndarray
    area_share: float

    @property
    def test_mask(self) -> np.ndarray:
        """Mask (B,) of the test loads."""
        return self.disc_index >= 0

    @property
    def training_mask(self) -> np.ndarray:
        """Mask (B,) of the training loads."""
        return self.disc_index == -1

    def is_covered(self, points: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of points (n, 3) [m] inside a disc; a scored model must not use data there."""
        return find_nearest(points, self.centres)[1] <= self.radius

    def summarise(self) -> str:
        """Describe the discs and the numbers of test and training loads in one line."""
        return (
            f"{len(self.centres)} discs of {1e3 * self.radius:g} mm radius ({100 * self.area_share:.0f} % of the open "
            f"cortex) left out: {int(self.test_mask.sum())} loads to test, {int(self.training_mask.sum())} to train on"
        )


def hold_out_discs(points: np.ndarray, patch: Patch, settings: DiscSettings = DiscSettings()) -> DiscSplit:
    """Hold out 6 mm discs round load points (B, 3) [m] far from each other: at least 6, and 15 % of the patch.

    Discs beyond the sixth are added only while at least half of the loads remain for training. At a small craniotomy,
    where six discs contain more than half of the loads, smaller radii are used. The few positions of the preset `seed`
    exceed half at any radius.

    Raises
    ------
    InputError
        The loads have fewer than seven positions.
    """
    order = pick_far_points(points, settings.max_positions) if len(points) else np.zeros(0, int)
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
    split = _build_split(points, candidates[: settings.min_discs], patch, radius)
    for count in range(settings.min_discs + 1, len(candidates)):
        if split.area_share >= settings.held_out_share:
            break
        more = _build_split(points, candidates[:count], patch, radius)
        if more.test_mask.mean() > 0.5:
            break
        split = more
    return split


def _build_split(points: np.ndarray, centres: np.ndarray, patch: Patch, radius: float) -> DiscSplit:
    which, distance = find_nearest(points, centres)
    return DiscSplit(centres, radius, np.where(distance <= radius, which, -1), patch.compute_coverage(centres, radius))


@dataclass(frozen=True, eq=False)
class SectorSplit(DiscSplit):
    """Split of loads by held-out sectors of the force's tangential direction.

    Fields are as in `DiscSplit`, but `centres` are unit directions (k, 3), `radius` is half the angle of a sector
    [rad], `disc_index` is the index of a load's sector, and `area_share` is the held-out share of the circle.
    """

    def is_covered(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of False: no point is held out, only directions."""
        return np.zeros(len(points), bool)

    def summarise(self) -> str:
        """Describe the sectors and the numbers of test and training loads in one line."""
        return (
            f"{len(self.centres)} sectors of {2.0 * np.degrees(self.radius):g} degrees round the cortex's normal left "
            f"out: {int(self.test_mask.sum())} loads to test, {int(self.training_mask.sum())} to train on"
        )


def hold_out_sectors(pushes: Pushed, patch: Patch) -> SectorSplit:
    """Hold out two opposite 45-degree sectors of the tangential direction of the forces.

    Forces within 10 degrees of the mean inward normal are training loads, as their tangential direction is unreliable.

    Raises
    ------
    InputError
        No load is inside the sectors, or none outside.
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

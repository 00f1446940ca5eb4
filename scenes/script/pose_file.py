"""Poses of a tracked body as a CSV file: seconds, millimetres and unit quaternions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim.errors import InputError
from surrogate.locating.observed_files import read_columns

TIME, PLACE, TURN = "time_s", ("x_mm", "y_mm", "z_mm"), ("qx", "qy", "qz", "qw")
# By how much a quaternion's length may differ from 1, and a place be from the origin [m].
ROUNDED, FARTHEST = 0.01, 100.0


def read_poses(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s] and poses (n, 4, 4) [m] of a file with the columns time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw.

    A pose leads from the body to the tracker: x_tracker = T x_body. Further columns are passed over.

    Raises
    ------
    InputError
        A file that is missing or no such table, times that do not ascend, quaternions that are not of length 1, or
        places farther than 100 m.
    """
    columns = read_columns(path, {(TIME, *PLACE, *TURN)}, others=True)
    times = columns[TIME]
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        raise InputError(f"{path}: row {back[0] + 3} is not later than the row before it: sort the rows by time_s.")
    places = 1e-3 * np.column_stack([columns[name] for name in PLACE])
    far = np.flatnonzero((np.abs(places) > FARTHEST).any(axis=1))
    if len(far):
        raise InputError(
            f"{path}: row {far[0] + 2} is farther than {FARTHEST:.0f} m from the tracker: give millimetres."
        )
    turns = np.column_stack([columns[name] for name in TURN])
    lengths = np.linalg.norm(turns, axis=1)
    odd = np.flatnonzero(~(np.abs(lengths - 1.0) <= ROUNDED))
    if len(odd):
        raise InputError(
            f"{path}: row {odd[0] + 2} has a quaternion of length {lengths[odd[0]]:.3g}: give qx,qy,qz,qw of length 1."
        )
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = _rotations(turns / lengths[:, None])
    poses[:, :3, 3] = places
    return times, poses


def _rotations(turns: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of unit quaternions (n, 4), scalars last."""
    x, y, z, w = turns.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)

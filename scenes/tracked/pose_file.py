"""CSV files of the poses of a tracked body: times [s], positions [mm] and unit quaternions; missing poses are blank."""

import csv
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ar.tracking.pose import Pose, PoseStatus
from ar.tracking.pose_stream import PoseStream, build_pose_stream
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from surrogate.locating.observed_files import read_columns

# Column names: time, position, rotation.
TIME, PLACE, TURN = "time_s", ("x_mm", "y_mm", "z_mm"), ("qx", "qy", "qz", "qw")
TIP, TIP_DEVIATION = ("tip_x_mm", "tip_y_mm", "tip_z_mm"), "tip_off_mm"  # Column names: tip, its standard deviation.
# Column names: upper triangle of the covariance.
COVARIANCE = tuple(f"cov_{row}{column}" for row in range(6) for column in range(row, 6))
# Column names: number of corners, residual, computing time, coordinate system.
LAST_COLUMNS = ("corners", "residual_px", "ms", "frame")
CAMERA = "camera: x right, y down, z forward"  # Description of the camera's coordinate system.
# Columns with the status of a body: whether the tracker saw it.
STATUS = "state", "valid", "visible", "tracked", "seen"
# Values of the status columns of a body that the tracker saw.
SEEN_VALUES = "ok", "good", "seen", "valid", "visible", "tracked", "tracking", "true", "yes", "1", "1.0"
MAX_NAMED_KINDS = 3  # Number of kinds of unseen rows that a warning names.
QUATERNION_TOLERANCE = 0.01  # Tolerance of a quaternion's length from 1.
MAX_COORDINATE = 100.0  # Largest distance of a position from the origin along an axis [m].
UNITS = np.repeat([1e3, 1.0], 3)  # Conversion of the covariance from metres and radians to millimetres and radians.
USUAL_DEVIATIONS = 0.25e-3, float(np.radians(0.1))
"""Default standard deviations of a tracker's poses, along each axis [m] and about each axis [rad]."""


def read_poses(path: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read poses from a file with the columns time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw.

    Returns the row numbers (n,) in the file, times (n,) [s] and poses (n, 4, 4) [m].

    A pose maps body coordinates to tracker coordinates: x_tracker = T x_body. Rows without a pose are skipped. Rows in
    which the tracker did not see the body (status not OK, pose of zeros, or identity) are skipped with a warning. Other
    columns are ignored.

    Raises
    ------
    InputError
        The file is missing or lacks these columns, times do not ascend, quaternions do not have the length 1, or
        positions are farther than 100 m.
    """
    times, poses, _ = _read_rows(path)
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        raise InputError(f"{path}: row {back[0] + 3} is not later than the row before it: sort the rows by time_s.")
    kept = np.flatnonzero(~np.isnan(poses[:, 0, 0]))
    return kept + 2, times[kept], poses[kept]


def read_pose_stream(path: str | Path) -> PoseStream:
    """Read the poses of an external tracker from a file as in `read_poses`; the clock may restart at midnight.

    Covariances are read from the columns `cov_00` to `cov_55` of `write_poses`; without these columns they are those
    of `USUAL_DEVIATIONS`.

    Raises
    ------
    InputError
        See `read_poses`; also if there is no pose, or an invalid covariance.
    """
    times, poses, covariances = _read_rows(path)
    kept = ~np.isnan(poses[:, 0, 0])
    if not _is_valid_covariance(covariances[kept]):
        raise InputError(f"{path}: has a covariance that is none: mend it, or leave its columns out.")
    try:
        return build_pose_stream(times[kept], poses[kept], covariances[kept])
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _read_rows(path: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read times (n,) [s], poses (n, 4, 4) [m] and covariances (n, 6, 6) of all rows; missing poses are NaN."""
    with_errors = (TIME, *PLACE, *TURN, *COVARIANCE)
    unseen = Counter[str]()
    columns = read_columns(path, {with_errors[:8], with_errors}, with_errors[1:], partial(_is_unseen, unseen=unseen))
    pose = np.column_stack([columns[name] for name in (*PLACE, *TURN)])
    zeros, same = ((np.abs(pose) == each).all(axis=1) for each in (np.zeros(7), np.eye(7)[6]))
    # A body whose pose is the identity in every row defines the frame of the other one.
    for rows, what in ((zeros, "zeros"), (same & ~same[~np.isnan(pose[:, 0])].all(), "the identity")):
        unseen.update({what: np.count_nonzero(rows)})
        for name in with_errors[1:8]:
            columns[name][rows] = np.nan
    if unseen.total():
        named = dict(unseen.most_common(MAX_NAMED_KINDS))
        named["other"] = unseen.total() - sum(named.values())
        counted = ", ".join(f"{count} {what}" for what, count in named.items() if count)
        warnings.warn(
            f"{path}: {unseen.total()} rows are not seen by the tracker and not used: {counted}", stacklevel=1
        )
    blank = np.isnan([columns[name] for name in (*PLACE, *TURN)])
    odd = np.flatnonzero(blank.any(axis=0) & ~blank.all(axis=0))
    if len(odd):
        raise InputError(f"{path}: row {odd[0] + 2} has a part of a pose: fill it in, or leave all of it blank.")
    places = 1e-3 * np.column_stack([columns[name] for name in PLACE])
    far = np.flatnonzero((np.abs(places) > MAX_COORDINATE).any(axis=1))
    if len(far):
        raise InputError(
            f"{path}: row {far[0] + 2} is farther than {MAX_COORDINATE:.0f} m from the tracker: give millimetres."
        )
    turns, kept = np.column_stack([columns[name] for name in TURN]), ~blank.any(axis=0)
    lengths = np.linalg.norm(turns, axis=1)
    odd = np.flatnonzero(kept & ~(np.abs(lengths - 1.0) <= QUATERNION_TOLERANCE))
    if len(odd):
        raise InputError(
            f"{path}: row {odd[0] + 2} has a quaternion of length {lengths[odd[0]]:.3g}: give qx,qy,qz,qw of length 1."
        )
    poses = np.full((len(turns), 4, 4), np.nan)
    poses[kept] = np.eye(4)
    poses[kept, :3, :3] = Rotation.from_quat(turns[kept]).as_matrix()
    poses[kept, :3, 3] = places[kept]
    return columns[TIME], poses, _read_covariances(columns, len(turns))


def _is_unseen(cells: Mapping[str, str], unseen: Counter[str]) -> bool:
    """Return True if the tracker did not see the body in a row (cells by column); count the reason in `unseen`."""
    pose = {cells[name].strip().casefold() for name in (*PLACE, *TURN)}
    status = {name: cell.strip() for name, cell in cells.items() if name in STATUS or name.endswith("status")}
    why = [f"{name} {cell[:20]!r}" for name, cell in status.items() if cell.casefold() not in SEEN_VALUES]
    why += ["nan"] if pose == {"nan"} else []
    unseen.update(why[:1] if pose != {""} else [])
    return bool(why)


def _read_covariances(columns: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Return covariances (n, 6, 6) [m, rad] from the columns of `write_poses`, or default covariances."""
    if COVARIANCE[0] not in columns:
        return np.tile(np.diag(np.repeat(np.square(USUAL_DEVIATIONS), 3)), (count, 1, 1))
    upper = np.zeros((count, 6, 6))
    upper[(slice(None), *np.triu_indices(6))] = np.column_stack([columns[name] for name in COVARIANCE])
    whole = upper + np.triu(upper, 1).transpose(0, 2, 1)
    return whole / np.outer(UNITS, UNITS)


def _is_valid_covariance(matrices: np.ndarray) -> bool:
    """Return True if symmetric matrices (n, 6, 6) are finite and positive semi-definite, within file rounding."""
    if not np.isfinite(matrices).all():
        return False
    values = np.linalg.eigvalsh(matrices * np.outer(UNITS, UNITS))
    return bool((values[:, 0] >= -1e-3 * values[:, -1]).all())


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Tracking result of an image: time [s], status, pose (None if uncertain or missing), and processing time [s].

    Without a pose, `missing_target` is the name of the target to which the status applies.
    """

    time: float
    verdict: PoseStatus
    pose: Pose | None
    seconds: float
    missing_target: str = ""


def write_poses(path: Path, rows: Iterable[TrackedPose], tip: np.ndarray) -> None:
    """Write a CSV file with a row for each image, atomically; rows without a pose have blank cells.

    `tip` (3,) [m] is the position of the tool's tip in body coordinates. The columns of the covariance are its upper
    triangle, row by row, for x, y, z [mm] and a small rotation about the body's origin, in the camera's axes [rad].
    """
    with write_atomically(path, ".csv") as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow((TIME, "state", *PLACE, *TURN, *TIP, TIP_DEVIATION, *COVARIANCE, *LAST_COLUMNS))
        for row in rows:
            end = f"{1e3 * row.seconds:.2f}", CAMERA
            cells = [""] * (len(PLACE) + len(TURN) + len(TIP) + 1 + len(COVARIANCE) + 2)
            if row.pose is not None:
                cells = [*_format_pose(row.pose, tip), str(row.pose.corners), f"{row.pose.residual:.3f}"]
            table.writerow((f"{row.time:.6f}", row.verdict.name.lower(), *cells, *end))


def _format_pose(pose: Pose, tip: np.ndarray) -> list[str]:
    """Format the cells of a pose: position, rotation, tip with its root mean square error, and covariance."""
    T = pose.T_camera_target
    at, spread = pose.transform_point(tip)
    covariance = (pose.covariance * np.outer(UNITS, UNITS))[np.triu_indices(6)]
    return [
        *(f"{each:.4f}" for each in 1e3 * T[:3, 3]),
        *(f"{each:.8f}" for each in Rotation.from_matrix(T[:3, :3]).as_quat()),
        *(f"{each:.4f}" for each in 1e3 * at),
        f"{1e3 * np.sqrt(np.trace(spread)):.4f}",
        *(f"{each:.4g}" for each in covariance),
    ]

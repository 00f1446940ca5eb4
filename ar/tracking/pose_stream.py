"""Pose streams of an external tracker: interpolation between samples, and the time offset of its clock."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .pose import Pose
from .rigid import to_rotation_vectors

MAX_GAP = 0.1  # Largest gap between samples with interpolation [s].
MAX_EXTRAPOLATION = 0.05  # Largest extrapolation after the last sample [s].
TIME_TOLERANCE = 1e-3  # Difference below which times count as equal [s]: files round them.
DAY_SECONDS = 86_400.0
"""Period of a 24-hour clock [s]."""
# Remedy in error messages.
REMEDY = "Move the tool to and fro by centimetres, quickly and unevenly, while markers and poses are both seen."


@dataclass(frozen=True)
class ClockSettings:
    """Settings of `estimate_clock_offset`."""

    offset_step: float = 0.01  # Step of tried time offsets [s].
    min_images: int = 8  # Minimum number of images for an estimate of the time offset.
    max_offset_range: float = 900.0  # Largest range of tried offsets [s].
    min_motion: float = 1e-3  # Smallest motion of the tool that determines the offset [m].
    min_offset_difference: float = 0.15  # Time difference beyond which a second minimum is another offset [s].
    min_squares_ratio: float = 2.0  # Smallest ratio of the sum of squares at another offset to that of the best fit.
    # Noise level of positions [m]: lower bound of the best fit's error in the comparison of offsets.
    position_noise: float = 0.1e-3
    max_iterations: int = 20  # Maximum number of Gauss-Newton iterations of the offset.


def unwrap_times(times: np.ndarray) -> np.ndarray:
    """Add days to times (n,) [s] of a 24-hour clock after midnight; times of other clocks are unchanged."""
    back = np.diff(times) < -0.5 * DAY_SECONDS
    return times + DAY_SECONDS * np.concatenate([[0], np.cumsum(back)]) if _is_time_of_day(times) else times


def _is_time_of_day(times: np.ndarray) -> bool:
    return bool(len(times) and times.min() >= 0.0 and times.max() < DAY_SECONDS)


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Samples of the pose of a body in its tracker's frame.

    Parameters
    ----------
    times
        Ascending times (n,) [s] on the tracker's clock.
    poses
        Poses T_tracker_body (n, 4, 4) [m].
    covariances
        Covariances (n, 6, 6) of translation [m] and rotation [rad] about the body's origin, both in the axes of the
        tracker frame.
    has_daily_clock
        True if the clock restarts after 24 hours; times are then known up to whole days.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    has_daily_clock: bool = False

    def interpolate(self, time: float) -> Pose | None:
        """Interpolate the pose at a time [s], at constant velocity between two samples; None if not available.

        Gaps longer than `MAX_GAP` are not interpolated. After the last sample of the stream or before such a gap, the
        motion is extrapolated for at most `MAX_EXTRAPOLATION`. The covariance includes the interpolation error, for a
        body that accelerates as in the neighbouring samples.
        """
        time = self.to_stream_time(time)
        first = int(np.searchsorted(self.times, time + TIME_TOLERANCE, side="right")) - 1
        if first < 0:
            return None
        if first + 1 == len(self.times) or self.times[first + 1] - self.times[first] > MAX_GAP:
            if abs(time - self.times[first]) <= TIME_TOLERANCE:
                return Pose(self.poses[first], self.covariances[first], 0.0, 0)
            first -= 1
            if first < 0 or self.times[first + 1] - self.times[first] > MAX_GAP:
                return None
        second = first + 1
        if time - self.times[second] > MAX_EXTRAPOLATION:
            return None
        return self._interpolate_pose(first, second, time)

    def compute_age(self, time: float) -> float:
        """Return the time [s] from the last sample before `time` to `time`; infinite before the first sample."""
        time = self.to_stream_time(time)
        first = int(np.searchsorted(self.times, time, side="right")) - 1
        return np.inf if first < 0 else float(time - self.times[first])

    def to_stream_time(self, time: float) -> float:
        """Convert a time [s] to this stream's clock; a 24-hour clock gets the day nearest to the samples."""
        if not self.has_daily_clock:
            return time
        middle = 0.5 * float(self.times[0] + self.times[-1])
        return time - DAY_SECONDS * round((time - middle) / DAY_SECONDS)

    def _interpolate_pose(self, first: int, second: int, time: float) -> Pose:
        since, until = time - self.times[first], self.times[second] - time
        share = float(since / (since + until))
        a, b = self.poses[first], self.poses[second]
        T = np.eye(4)
        turn = Rotation.from_matrix(b[:3, :3] @ a[:3, :3].T).as_rotvec()
        T[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ a[:3, :3]
        T[:3, 3] = (1.0 - share) * a[:3, 3] + share * b[:3, 3]
        own = (1.0 - share) ** 2 * self.covariances[first] + share**2 * self.covariances[second]
        bent = 0.5 * abs(since * until) * self._compute_acceleration(first, second)
        return Pose(T, own + np.diag(np.repeat(bent**2, 3)), 0.0, 0)

    def _compute_acceleration(self, first: int, second: int) -> np.ndarray:
        """Compute the largest accelerations (2,) near two samples: translation [m/s^2], rotation [rad/s^2]."""
        low, high = max(0, first - 1), min(len(self.times), second + 2)
        times, poses = self.times[low:high], self.poses[low:high]
        steps = np.diff(times)
        if len(steps) < 2:
            return np.zeros(2)
        shifts = np.diff(poses[:, :3, 3], axis=0) / steps[:, None]
        turns = to_rotation_vectors(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1)) / steps[:, None]
        apart = 0.5 * (steps[1:] + steps[:-1])
        near = apart <= MAX_GAP
        changes = [np.linalg.norm(np.diff(each, axis=0), axis=1) / apart for each in (shifts, turns)]
        return np.array([each[near].max(initial=0.0) for each in changes])


def build_pose_stream(times: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> PoseStream:
    """Build a stream from a tracker's samples; times of a 24-hour clock are unwrapped at midnight.

    Raises
    ------
    ValueError
        There are no samples, or the times do not ascend.
    """
    if not len(times):
        raise ValueError("holds no pose: record some while both bodies are seen.")
    going_on = unwrap_times(times)
    back = np.flatnonzero(np.diff(going_on) <= 0.0)
    if len(back):
        raise ValueError(f"pose {back[0] + 2} is not later than the one before it: sort the rows by time_s.")
    return PoseStream(going_on, poses, covariances, _is_time_of_day(times))


@dataclass(frozen=True)
class Clock:
    """Offset of clocks: tracker time = image time + `offset` [s]; `error` is the offset's standard deviation [s]."""

    offset: float = 0.0
    error: float = 0.0


def estimate_clock_offset(
    times: np.ndarray, positions: np.ndarray, tracker_times: np.ndarray, tracker_positions: np.ndarray,
    settings: ClockSettings = ClockSettings(),
) -> Clock:  # fmt: skip
    """Estimate a tracker's clock offset from a point's motion in images (n, 3) [m] and by the tracker (m, 3) [m].

    Positions, with times [s], may differ by a constant. The error is that of least squares, from scatter of residuals.

    Raises
    ------
    ValueError
        There are too few images, the motion is too small, no offset has poses for all images, or two offsets fit about
        equally well.
    """
    if len(times) < settings.min_images:
        raise ValueError(
            f"{len(times)} images show what the poses have, and {settings.min_images} are needed. {REMEDY}"
        )
    low, high = tracker_times[0] - times[0], tracker_times[-1] - times[-1]
    if high < low:
        raise ValueError("the poses end before the images do: record them for longer than the video.")
    if high - low > settings.max_offset_range:
        raise ValueError(
            f"the poses are {high - low:.0f} s longer than the video: cut them to {settings.max_offset_range:.0f} s."
        )
    tried = np.arange(low, high + settings.offset_step, settings.offset_step).clip(low, high)
    squares = np.array(
        [_sum_squares(_compute_errors(times + offset, positions, tracker_times, tracker_positions)) for offset in tried]
    )
    if not np.isfinite(squares).any():
        raise ValueError(f"the poses have gaps of more than {MAX_GAP:g} s wherever the images are.")
    best = int(np.argmin(squares))
    clock, least = _refine_offset(float(tried[best]), times, positions, tracker_times, tracker_positions, settings)
    walled = np.pad(squares, 1, constant_values=np.inf)
    valley = (squares <= walled[:-2]) & (squares <= walled[2:])
    far = np.where(valley & (np.abs(tried - tried[best]) > settings.min_offset_difference), squares, np.inf)
    if np.isfinite(far.min()):
        _, rival = _refine_offset(
            float(tried[int(np.argmin(far))]), times, positions, tracker_times, tracker_positions, settings
        )
        if rival < settings.min_squares_ratio * max(least, positions.size * settings.position_noise**2):
            raise ValueError(f"more than one offset of the clocks fits. {REMEDY}")
    return clock


def _refine_offset(
    offset: float, times: np.ndarray, positions: np.ndarray, tracker_times: np.ndarray, tracker_positions: np.ndarray,
    settings: ClockSettings,
) -> tuple[Clock, float]:  # fmt: skip
    """Refine an offset by Gauss-Newton; return the clock and the remaining sum of squares [m^2]."""
    low, high = tracker_times[0] - times[0], tracker_times[-1] - times[-1]
    speed, off = np.zeros_like(positions), np.zeros_like(positions)
    for _ in range(settings.max_iterations):
        off = _compute_errors(times + offset, positions, tracker_times, tracker_positions)
        ahead, behind = min(offset + settings.offset_step, high), max(offset - settings.offset_step, low)
        speed = _compute_errors(times + ahead, positions, tracker_times, tracker_positions) - _compute_errors(
            times + behind, positions, tracker_times, tracker_positions
        )
        speed /= max(ahead - behind, np.finfo(float).tiny)
        step = -float((speed * off).sum() / max((speed**2).sum(), np.finfo(float).tiny))
        offset = float(np.clip(offset + np.clip(step, -settings.offset_step, settings.offset_step), low, high))
        if abs(step) < 1e-6:
            break
    moved = float(np.sqrt((speed**2).sum(axis=1).mean())) * float(times[-1] - times[0])
    if not moved > settings.min_motion:
        raise ValueError(f"the tool moves by {1e3 * moved:.1f} mm only: that says nothing of the clocks. {REMEDY}")
    left = _sum_squares(_compute_errors(times + offset, positions, tracker_times, tracker_positions))
    scatter = np.sqrt(left / max(off.size - 4, 1))
    return Clock(offset, float(scatter / np.sqrt((speed**2).sum()))), left


def _compute_errors(times: np.ndarray, positions: np.ndarray, samples: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    """Compute differences (n, 3) of tracker and `positions` at times (n,), minus their mean; NaN in gaps."""
    there = np.column_stack([np.interp(times, samples, column) for column in tracked.T])
    after = np.searchsorted(samples, times).clip(1, len(samples) - 1)
    there[samples[after] - samples[after - 1] > MAX_GAP] = np.nan
    off = there - positions
    return off - off.mean(axis=0)


def _sum_squares(differences: np.ndarray) -> float:
    total = float((differences**2).sum())
    return total if np.isfinite(total) else np.inf

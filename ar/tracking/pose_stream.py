"""Poses of another tracker, sampled at times of its own: what they are between two samples, and where they are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .pose import Pose
from .rigid import turn_vectors

# Two samples that are farther apart have none between them; nobody knows a pose so long after the last one [s].
LONGEST, AHEAD = 0.1, 0.05
# Times that are nearer are one [s]: files round them.
ROUNDING = 1e-3
DAY = 86_400.0
"""Seconds after which a clock of 24 hours begins anew."""


def unwrapped(times: np.ndarray) -> np.ndarray:
    """Times (n,) [s] of a clock of 24 hours, which go on at midnight; those of other clocks are left as they are."""
    back = np.diff(times) < -0.5 * DAY
    return times + DAY * np.concatenate([[0], np.cumsum(back)]) if _of_a_day(times) else times


def _of_a_day(times: np.ndarray) -> bool:
    return bool(len(times) and times.min() >= 0.0 and times.max() < DAY)


@dataclass(frozen=True, eq=False)
class PoseStream:
    """A body's poses in its tracker's frame.

    Parameters
    ----------
    times
        (n,) [s] of the tracker's clock, ascending.
    poses
        (n, 4, 4) [m]: T_tracker_body.
    covariances
        (n, 6, 6) of a shift [m] in the tracker's frame and a small turn [rad] about the body's origin in its axes.
    daily
        Whether the clock begins anew after 24 hours: then times are meant up to whole days.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    daily: bool = False

    def at(self, time: float) -> Pose | None:
        """The pose at a time [s], by turning and shifting evenly between two samples; None where there is none.

        Two samples that are more than `LONGEST` apart have none between them. Past a sample that no other follows in
        time, the last motion goes on for `AHEAD`. The covariance grows by what a body that speeds up as it does here
        may be off an even motion.
        """
        time = self.in_its_day(time)
        first = int(np.searchsorted(self.times, time + ROUNDING, side="right")) - 1
        if first < 0:
            return None
        if first + 1 == len(self.times) or self.times[first + 1] - self.times[first] > LONGEST:
            if abs(time - self.times[first]) <= ROUNDING:
                return Pose(self.poses[first], self.covariances[first], 0.0, 0)
            first -= 1
            if first < 0 or self.times[first + 1] - self.times[first] > LONGEST:
                return None
        second = first + 1
        if time - self.times[second] > AHEAD:
            return None
        return self._between(first, second, time)

    def age(self, time: float) -> float:
        """How long before a time [s] the last sample was; infinite before the first."""
        time = self.in_its_day(time)
        first = int(np.searchsorted(self.times, time, side="right")) - 1
        return np.inf if first < 0 else float(time - self.times[first])

    def in_its_day(self, time: float) -> float:
        """A time [s] as this stream's clock has it: of a clock of 24 hours, on the day nearest to its samples."""
        if not self.daily:
            return time
        middle = 0.5 * float(self.times[0] + self.times[-1])
        return time - DAY * round((time - middle) / DAY)

    def _between(self, first: int, second: int, time: float) -> Pose:
        since, until = time - self.times[first], self.times[second] - time
        share = float(since / (since + until))
        a, b = self.poses[first], self.poses[second]
        T = np.eye(4)
        turn = Rotation.from_matrix(b[:3, :3] @ a[:3, :3].T).as_rotvec()
        T[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ a[:3, :3]
        T[:3, 3] = (1.0 - share) * a[:3, 3] + share * b[:3, 3]
        own = (1.0 - share) ** 2 * self.covariances[first] + share**2 * self.covariances[second]
        bent = 0.5 * abs(since * until) * self._quickening(first, second)
        return Pose(T, own + np.diag(np.repeat(bent**2, 3)), 0.0, 0)

    def _quickening(self, first: int, second: int) -> np.ndarray:
        """The largest change of speed (2,) round two samples, of shifts [m/s^2] and turns [rad/s^2]."""
        low, high = max(0, first - 1), min(len(self.times), second + 2)
        times, poses = self.times[low:high], self.poses[low:high]
        steps = np.diff(times)
        if len(steps) < 2:
            return np.zeros(2)
        shifts = np.diff(poses[:, :3, 3], axis=0) / steps[:, None]
        turns = turn_vectors(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1)) / steps[:, None]
        apart = 0.5 * (steps[1:] + steps[:-1])
        near = apart <= LONGEST
        changes = [np.linalg.norm(np.diff(each, axis=0), axis=1) / apart for each in (shifts, turns)]
        return np.array([each[near].max(initial=0.0) for each in changes])


def stream_of(times: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> PoseStream:
    """A stream of samples as a tracker wrote them: at midnight a clock of 24 hours begins anew.

    Raises
    ------
    ValueError
        No sample, or times that do not ascend.
    """
    if not len(times):
        raise ValueError("holds no pose: record some while both bodies are seen.")
    going_on = unwrapped(times)
    back = np.flatnonzero(np.diff(going_on) <= 0.0)
    if len(back):
        raise ValueError(f"pose {back[0] + 2} is not later than the one before it: sort the rows by time_s.")
    return PoseStream(going_on, poses, covariances, _of_a_day(times))

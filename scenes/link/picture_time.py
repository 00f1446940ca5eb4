"""Where a camera was when a picture was taken: between the poses round that time, or near the newest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ar.tracking.pose_stream import LONGEST, PoseStream

from .frame import time_of
from .heard import Sent

# Of fewer poses nobody can say how evenly a camera moves between them.
EVEN = 3


@dataclass(frozen=True, eq=False)
class Placed:
    """A camera's pose T (4, 4) [m] in the reference's frame, and how far off a place may be as the camera moves [m]."""

    T: np.ndarray
    moved: float


def placed_at(course: Sequence[Sent], now: float, stamp: int, place: np.ndarray, stale: float) -> Placed | str:
    """A camera's pose at a picture's time stamp, of its poses so far, the newest last; or why nobody knows it.

    Between two poses it is read as `PoseStream.at` does, and just past the newest, too. The error is by how much the
    camera may speed up between them, at a place (3,) [m] in the reference's frame. Elsewhere, and of fewer than three
    poses, it is the newest pose, and how far the place has moved since in the picture. Without stamps the time is when
    messages came. A reason has {name} in the stead of the transform's name.
    """
    body = course[-1]
    stamped = bool(stamp and all(sent.stamp for sent in course))
    times = np.array([time_of(sent.stamp) if stamped else sent.arrived for sent in course])
    time = time_of(stamp) if stamped else now
    poses = np.stack([sent.T for sent in course])
    if stamped and len(course) >= EVEN and np.ptp(times[-EVEN:]) <= LONGEST * EVEN:
        between = PoseStream(times, poses, np.zeros((len(course), 6, 6))).at(time)
        if between is not None:
            arm = float(np.linalg.norm(place - between.T_camera_target[:3, 3]))
            shift, turn = np.sqrt(np.diag(between.covariance)[[0, 3]])
            return Placed(between.T_camera_target, float(shift + turn * arm))
    apart = abs(time - times[-1])
    if apart > stale:
        return f"no {{name}} within {stale:g} s of the picture's time"
    if len(course) < 2:
        return "one {name} alone, which does not say how fast the camera moves"
    step = times[-1] - times[-2]
    here, there = (np.linalg.inv(T) @ np.append(place, 1.0) for T in poses[-1:-3:-1])
    way = float(np.linalg.norm((here - there)[:3]))
    return Placed(body.T, way * apart / step if step > 0.0 else np.inf)

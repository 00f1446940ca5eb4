"""Solver that computes positions of tumour and open cortex, and their errors, from received poses of a tool."""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from ar.overlay.gauge import DistanceGauge
from ar.tracking.pose import Pose, TrackedTargets
from ar.tracking.pose_stream import MAX_GAP, PoseStream
from ar.tracking.registration import Registration

from ..script.uncertainty import LEVEL
from ..tracked.follower import (
    UNCHECKED_WARNING,
    UNKNOWN_WARNING,
    FollowerSettings,
    TrackingResult,
    TumourState,
    compute_tip_covariance,
    describe_large_error,
)
from ..tracked.overlay_painter import Painter
from ..tracked.plausible import describe_misplaced_tool
from ..tracked.tool_motion import ToolMotion
from ..tracked.tracked_tool import TrackedTool
from .frame import to_stamp, to_time
from .received_transforms import ReceivedTransform, ReceivedTransforms

MIN_POSES = 3  # Minimum number of poses to estimate the camera's acceleration between them.
OWNER_QUESTION = "are these its poses and registration?"  # Question in the warning about a misplaced tool.
NO_TARGETS = TrackedTargets(0, {}, {}, {})  # Tracking result without targets.
TIMED_DEPTH = 2e-3  # Depth of the tool whose solution is timed at the start [m].


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Camera pose T (4, 4) [m] in the reference's frame; `motion_error` [m]: error of a position by camera motion."""

    T: np.ndarray
    motion_error: float


def interpolate_camera_pose(
    received: Sequence[ReceivedTransform], arrival_time: float, stamp: int, position: np.ndarray, max_age: float
) -> CameraPose | str:
    """Interpolate a camera's pose at an image's time stamp `stamp` from its `received` poses (newest last).

    With three or more dense poses, the result is from `PoseStream.interpolate`, and the error of a position (3,) [m]
    in the reference's frame follows from its covariance. Otherwise the result is the newest pose, and the error is the
    motion of the position since this pose, at the last speed. Without time stamps, times of arrival are used. If the
    pose is unknown, the reason is returned, with {name} instead of the transform's name.
    """
    body = received[-1]
    stamped = bool(stamp and all(sent.stamp for sent in received))
    times = np.array([to_time(sent.stamp) if stamped else sent.arrived for sent in received])
    time = to_time(stamp) if stamped else arrival_time
    poses = np.stack([sent.T for sent in received])
    if stamped and len(received) >= MIN_POSES and np.ptp(times[-MIN_POSES:]) <= MAX_GAP * MIN_POSES:
        between = PoseStream(times, poses, np.zeros((len(received), 6, 6))).interpolate(time)
        if between is not None:
            arm = float(np.linalg.norm(position - between.T_camera_target[:3, 3]))
            shift, turn = np.sqrt(np.diag(between.covariance)[[0, 3]])
            return CameraPose(between.T_camera_target, float(shift + turn * arm))
    apart = abs(time - times[-1])
    if apart > max_age:
        return f"no {{name}} within {max_age:g} s of the image's time"
    if len(received) < 2:
        return "one {name} alone, which does not say how fast the camera moves"
    step = times[-1] - times[-2]
    here, there = (np.linalg.inv(T) @ np.append(position, 1.0) for T in poses[-1:-3:-1])
    way = float(np.linalg.norm((here - there)[:3]))
    return CameraPose(body.T, way * apart / step if step > 0.0 else np.inf)


@dataclass(frozen=True, eq=False)
class PoseResult:
    """Result for a pose of the tool.

    Parameters
    ----------
    stamp
        Time stamp of the pose, or of the computation if the pose has no time stamp or there is no result.
    tracking
        Positions of tumour and cortex, with the state and the warning of the overlay.
    gauge
        Distance from tip to tumour; None if not available.
    """

    stamp: int
    tracking: TrackingResult
    gauge: DistanceGauge | None = None


@dataclass(frozen=True, eq=False)
class CameraView:
    """Pose of the scan in a camera's frame: T_camera_scan (4, 4) [m].

    `motion_error` is the error [m] of the tumour's position due to the time between pose and image.
    """

    T_camera_scan: np.ndarray
    motion_error: float


@dataclass(frozen=True, eq=False)
class PoseResponder:
    """Solver for poses. Results depend only on the received transforms, except for the initial values of a solve.

    Parameters
    ----------
    motion
        Model of the brain's motion under a tool.
    tool
        Shape of the tool, and its pose in the frame of the tracked body.
    tracking
        Standard deviation of the tip's position along each axis [m]; messages do not contain it.
    registration
        Registration from a file; None: the registration is received, and its error and patient are unknown.
    """

    motion: ToolMotion
    tool: TrackedTool
    tracking: float
    registration: Registration | None = None

    def compute_result(
        self, transforms: ReceivedTransforms, time: float, wall_time: float, previous: TrackingResult | None = None
    ) -> PoseResult:
        """Compute the result at `time` [s], which is `wall_time` [s since 1970]; a solve starts from `previous`."""
        registration = self._find_registration(transforms)
        if isinstance(registration, str):
            return self._build_unknown_pose(registration, wall_time, previous)
        body = transforms.find_relative_transform(transforms.names.tool, time)
        if isinstance(body, str):
            return self._build_unknown_pose(body, wall_time, previous)
        stamp = body.stamp or to_stamp(wall_time)
        beside = Pose(body.T, np.diag(np.repeat([self.tracking**2, 0.0], 3)), 0.0, 0)
        pose = np.linalg.inv(registration.T_patient_scan) @ body.T @ self.tool.T_cube_tool
        spread = compute_tip_covariance(registration, self.tool, beside)
        motion = self.motion.compute_motion(pose, spread, None if previous is None else previous.motion)
        known = TrackingResult(
            to_time(stamp), TumourState.GOOD if motion.distance > 0.0 else TumourState.REST, "",
            NO_TARGETS, motion, None, pose, spread,
        )  # fmt: skip
        known = replace(known, reference_time=known.time, tool_time=wall_time, **self._describe_doubts(known, previous))
        if known.state is TumourState.UNKNOWN:
            return PoseResult(stamp, known)
        known = self._add_bound(known, registration)
        if known.is_reliable and registration.scan is None:
            known = replace(known, state=TumourState.UNSURE, warning=UNCHECKED_WARNING)
        stage = self.motion.stage
        gauge = Painter(stage, self.tool).measure_tip_distance(known, stage.build_tumour(motion.positions))
        return PoseResult(stamp, known, gauge)

    def measure_solve_time(self) -> float:
        """Measure the time [s] of a solution with the tool 2 mm deep in the craniotomy, after kernels are compiled."""
        site, pose = self.motion.stage.site, np.eye(4)
        pose[:3] = np.column_stack([site.right, site.up, -site.axis, site.origin + TIMED_DEPTH * site.axis])
        self.motion.compute_motion(pose, self.tracking**2 * np.eye(3))
        begun = clock.perf_counter()
        self.motion.compute_motion(pose, self.tracking**2 * np.eye(3))
        return clock.perf_counter() - begun

    def find_camera(self, transforms: ReceivedTransforms, time: float, stamp: int) -> CameraView | str:
        """Return the scan's pose in the camera's frame at an image's time stamp, or the reason why it is unknown."""
        name = transforms.names.camera
        registration, body = self._find_registration(transforms), transforms.find_relative_transform(name, time)
        if isinstance(registration, str) or isinstance(body, str):
            return registration if isinstance(registration, str) else str(body)
        middle = registration.T_patient_scan @ np.append(self.motion.stage.tumour_at_rest.vertices.mean(axis=0), 1.0)
        placed = interpolate_camera_pose(transforms.list_transforms(name), time, stamp, middle[:3], transforms.max_age)
        if isinstance(placed, str):
            return placed.format(name=name)
        return CameraView(np.linalg.inv(placed.T) @ registration.T_patient_scan, placed.motion_error)

    def _find_registration(self, transforms: ReceivedTransforms) -> Registration | str:
        """Return the registration from the file or from the last message, or the reason why it is not available."""
        if self.registration is not None:
            return self.registration
        sent = transforms.newest.get(transforms.names.registration)
        if sent is None:
            return f"no {transforms.names.registration} yet"
        return Registration(np.linalg.inv(sent.T), np.zeros((6, 6)), np.zeros(3), 0.0, 0)

    def _describe_doubts(self, tracking: TrackingResult, previous: TrackingResult | None) -> dict[str, object]:
        """Return fields to change in a result: `was_near`, and `state` and `warning` if the result is unreliable."""
        near = previous is not None and previous.was_near
        assert tracking.T_scan_tool is not None
        doubt, near = describe_misplaced_tool(self.tool, tracking.T_scan_tool, self.motion.stage, near, OWNER_QUESTION)
        doubt = doubt or tracking.motion.warning
        if doubt:
            return {"state": TumourState.UNSURE, "warning": doubt, "was_near": near}
        if not tracking.motion.supported:
            return {"state": TumourState.UNKNOWN, "warning": UNKNOWN_WARNING, "was_near": near}
        return {"was_near": near}

    def _add_bound(self, tracking: TrackingResult, registration: Registration) -> TrackingResult:
        """Add the bound on the tumour's error, and its parts by source, to a result if the result is reliable."""
        if not tracking.is_reliable:
            return tracking
        middle = tracking.motion.positions[self.motion.stage.tumour_vertices].mean(axis=0)
        _, covariance = registration.transform_point(middle)
        registered = float(np.sqrt(chi2.ppf(LEVEL, 3) * max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
        parts = {"registration": registered, "tool": tracking.motion.tool_error, "model": tracking.motion.model_error}
        band = float(np.hypot(registered, tracking.motion.error))
        return add_error_bound(tracking, band, parts)

    def _build_unknown_pose(self, reason: str, time: float, previous: TrackingResult | None) -> PoseResult:
        """Build the result for an unknown pose, with the reason as warning."""
        tool_time = None if previous is None else previous.tool_time
        near = previous is not None and previous.was_near
        state = TumourState.NO_TOOL if tool_time is None else TumourState.STALE
        motion = self.motion.rest_motion if previous is None else previous.motion
        return PoseResult(
            to_stamp(time), TrackingResult(time, state, reason, NO_TARGETS, motion, tool_time=tool_time, was_near=near)
        )  # fmt: skip


def add_error_bound(tracking: TrackingResult, bound: float, contributions: dict[str, float]) -> TrackingResult:
    """Add an error bound [m] and its parts by source to a result; if it exceeds 5 mm, the result is unreliable."""
    if bound <= FollowerSettings().max_overlay_error:
        return replace(tracking, bound=bound, sources=contributions)
    return replace(tracking, state=TumourState.UNSURE, warning=describe_large_error(bound), bound=None, sources={})


def mark_late(result: PoseResult, age: float, max_age: float) -> PoseResult:
    """Return the result, marked as stale if the age [s] of its pose exceeds `max_age`."""
    if age <= max_age or not (result.tracking.is_reliable or result.tracking.state is TumourState.UNSURE):
        return result
    words = f"stale, the result is {age:.1f} s old: do not rely on it"
    late = replace(result.tracking, state=TumourState.STALE, warning=words, bound=None)
    return replace(result, tracking=late, gauge=None)

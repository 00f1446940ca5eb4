"""Frame-by-frame tracking with a real camera: position and error of the tumour, and handling of lost targets."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera
from ar.tracking.intrinsics import compute_calibration_error
from ar.tracking.pose import Pose, TrackedTargets, Tracker
from ar.tracking.registration import Registration
from ar.tracking.targets import build_patient_reference, build_tool_cube

from ..script.uncertainty import BOUND_DEVIATIONS, LEVEL
from .agreement import Agreement
from .external_tracker import ExternalTracker
from .plausible import describe_implausible_registration, describe_misplaced_tool
from .tool_motion import BrainMotion, ToolMotion
from .tracked_tool import TrackedTool

MAX_INTERVAL = 1.0  # Maximum interval between images [s].
TIME_ROUNDING = 1e-6  # Rounding of image times [s].


@dataclass(frozen=True)
class FollowerSettings:
    """Settings of a `Follower`."""

    # Time for which the overlay keeps its position after the reference is lost [s]: hand-held, its error is then less
    # than `max_overlay_error`.
    hold_time: float = 0.1
    max_gap: float = 0.2  # Longest gap between images [s].
    max_gap_intervals: float = 1.5  # Longest gap of a slow video [intervals].
    max_overlay_error: float = 5e-3  # Largest position error of a reliable overlay [m].
    # Overlay error as a share of the motion during the readout of a rolling shutter: measured in
    # docs/notes/overlay_experiments.md, "Rolling shutter".
    shutter_factor: float = 0.5
    # Factor on the overlay error of a rolling shutter for a tool's tip, which is far from its cube: the same page.
    tip_factor: float = 2.0
    speed_decay: float = 0.1  # Factor on the estimate of a maximum hand speed after one second without faster motion.


# Warnings in the image.
UNKNOWN_WARNING = "scan position, tissue motion unknown: do not rely on it"
UNCHECKED_WARNING = "not checked whose registration this is: make one by `sulcus register --anatomy`"
NO_PACE_WARNING = "a rolling shutter, and how the camera moves is not known yet: do not rely on it"
TOOL, PATIENT = build_tool_cube().name, build_patient_reference().name  # Names of the targets.


class TumourState(Enum):
    """State of the tumour position that is drawn in an image."""

    GOOD = "where it is now"
    REST = "as in the scan"
    UNKNOWN = "as in the scan, its motion not known"
    UNSURE = "not to be relied on"
    NO_TOOL = "tool lost"
    STALE = "stale"
    NO_REFERENCE = "reference lost"


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Tracking result of one image.

    Parameters
    ----------
    time
        Time of the image [s].
    state, warning
        State of the tumour position, and the reason for users if the position is limited or unreliable, else empty.
    targets
        Detected printed targets.
    motion
        Estimated motion of the brain.
    camera
        Camera with T_camera_scan; None if the reference has been lost for longer than `FollowerSettings.hold_time`.
    T_scan_tool, tip_covariance
        Pose (4, 4) [m] of the tool, and covariance (3, 3) [m^2] of its tip; None if the tool's pose is not available.
    bound
        95 % bound on the tumour's error across the line of sight [m]; None if not available.
    sources
        Contributions to `bound` [m], by source.
    reference_time, tool_time
        Times [s] of the last pose of the reference, and of the last pose of the tool relative to it; None: never.
    interval
        Shortest interval between two previous images [s].
    was_near
        True if the tool has been near the head; before that, the registration may be that of another patient.
    image_speed
        Recent maximum speed of the brain across the image [m/s]; None: not known.
    agreement
        Consistency of an external tracker's poses with printed targets in the images.
    """

    time: float
    state: TumourState
    warning: str
    targets: TrackedTargets
    motion: BrainMotion
    camera: Camera | None = None
    T_scan_tool: np.ndarray | None = None
    tip_covariance: np.ndarray | None = None
    bound: float | None = None
    sources: Mapping[str, float] = field(default_factory=dict)
    reference_time: float | None = None
    tool_time: float | None = None
    interval: float = MAX_INTERVAL
    was_near: bool = False
    image_speed: float | None = None
    agreement: Agreement = field(default_factory=Agreement)

    @property
    def is_reliable(self) -> bool:
        """True if the drawn tumour position is reliable."""
        return self.state in (TumourState.GOOD, TumourState.REST)


@dataclass(frozen=True, eq=False)
class Follower:
    """Tracker of reference and tool in the images of a calibrated camera, with the resulting motion of the brain.

    Parameters
    ----------
    calibration
        Calibration of the camera.
    registration
        Registration of the patient's reference to the scan.
    tool
        Tool with its cube; None: no tool is tracked.
    motion
        Model of the brain's motion under the tool.
    external
        External tracker, whose poses replace those of the cube and, if it has a `mount`, also those of the reference.
    intrinsic_covariance
        Covariance (9, 9) of the calibration's `ar.tracking.intrinsics.PARAMETERS`; None: not available.
    settings
        Limits and factors.
    """

    calibration: Calibration
    registration: Registration
    tool: TrackedTool | None
    motion: ToolMotion
    external: ExternalTracker | None = None
    intrinsic_covariance: np.ndarray | None = None
    settings: FollowerSettings = FollowerSettings()

    @cached_property
    def tracker(self) -> Tracker:
        """Tracker of the required printed targets."""
        wanted = (build_patient_reference(),) if self.tool is None else (build_patient_reference(), build_tool_cube())
        return Tracker(self.calibration.build_camera(np.eye(4)), wanted)

    def track(self, grey_image: np.ndarray, time: float, previous: TrackingResult | None = None) -> TrackingResult:
        """Compute the tracking result of an image (H, W) uint8 taken at a time [s]; `previous` is the last result.

        Raises
        ------
        ValueError
            See `Tracker.track`.
        """
        known = self._compare_targets(self._compute_result(grey_image, time, previous), previous)
        if previous is None:
            return known
        apart = time - previous.time
        known = replace(known, was_near=known.was_near or previous.was_near)
        return replace(known, interval=min(previous.interval, apart) if apart > 0.0 else previous.interval)

    def _compare_targets(self, result: TrackingResult, previous: TrackingResult | None) -> TrackingResult:
        """Compare external poses with printed targets; if they are inconsistent, mark the result as unreliable."""
        if self.external is None:
            return result
        agreement = Agreement() if previous is None else previous.agreement
        result = replace(result, agreement=self.external.compare_targets(result.time, result.targets.poses, agreement))
        if not result.agreement.inconsistency or not (result.is_reliable or result.state is TumourState.UNSURE):
            return result
        return replace(result, state=TumourState.UNSURE, warning=result.agreement.inconsistency, bound=None, sources={})

    def _compute_result(self, grey: np.ndarray, time: float, previous: TrackingResult | None) -> TrackingResult:
        """Compute the tracking result of one image, without updating `interval` and `agreement`."""
        apart = None if previous is None else time - previous.time
        usual = 0.0 if previous is None else previous.interval
        longest = max(self.settings.max_gap, self.settings.max_gap_intervals * usual)
        stale = apart is not None and not 0.0 < apart <= longest
        forgotten = previous is None or (apart is not None and not 0.0 <= apart <= longest)
        tracked = self.tracker.track(grey, None if previous is None or forgotten else previous.targets)
        other, reference = self.external, tracked.poses.get(PATIENT)
        if other is not None and other.mount is not None:
            reference = other.find_reference_pose(time)
        if reference is None:
            return self._build_without_reference(tracked, time, previous)
        T_patient_scan = self.registration.T_patient_scan
        camera = self.calibration.build_camera(reference.T_camera_target @ T_patient_scan)
        pace = self._compute_speed(reference, time, None if forgotten else previous)
        shutter = self.settings.shutter_factor * self.calibration.readout * (pace or 0.0)
        known = self._compute_motion(tracked, reference, time, previous, shutter)
        middle = known.motion.positions[self.motion.stage.tumour_vertices].mean(axis=0)
        band, parts = self._compute_bound(reference, middle, known.motion, shutter)
        known = replace(known, camera=camera, bound=band, sources=parts, reference_time=time, image_speed=pace)
        doubt, near = self._describe_implausible(camera, known.T_scan_tool, previous)
        known = replace(known, was_near=near)
        if known.is_reliable and pace is None and self.calibration.readout > 0.0:
            known = replace(known, state=TumourState.UNSURE, warning=NO_PACE_WARNING)
        if known.is_reliable and self.registration.scan is None:
            known = replace(known, state=TumourState.UNSURE, warning=UNCHECKED_WARNING)
        if doubt:
            known = replace(known, state=TumourState.UNSURE, warning=doubt)
        if doubt or known.state is TumourState.UNKNOWN:
            known = replace(known, bound=None, sources={})
        if stale and apart is not None:
            why = f"no image for {apart:.1f} s" if apart > 0.0 else "the camera repeats an image"
            return replace(known, state=TumourState.STALE, warning=f"stale, {why}: do not rely on it")
        if known.state in (TumourState.GOOD, TumourState.REST) and band > self.settings.max_overlay_error:
            return replace(known, state=TumourState.UNSURE, warning=describe_large_error(band))
        return known

    def _describe_implausible(
        self, camera: Camera, tool: np.ndarray | None, previous: TrackingResult | None
    ) -> tuple[str, bool]:
        """Return why the registration is implausible for this patient (or ""), and the updated `was_near`."""
        stage, near = self.motion.stage, previous is not None and previous.was_near
        theirs = "is this its registration?" if self.external is None else "are these its poses and registration?"
        misplaced, near = ("", near) if tool is None else describe_misplaced_tool(self.tool, tool, stage, near, theirs)
        doubt = describe_implausible_registration(self.registration, stage, camera) or misplaced
        return doubt, near

    def _build_without_reference(
        self, tracked: TrackedTargets, time: float, before: TrackingResult | None
    ) -> TrackingResult:
        """Return the result of an image without reference; the overlay keeps its position for `hold_time`."""
        seen = None if before is None else before.reference_time
        motion = self.motion.rest_motion if before is None else before.motion
        held = before is not None and seen is not None and 0.0 <= time - seen < self.settings.hold_time + TIME_ROUNDING
        camera = before.camera if before is not None and held else None
        why = self._describe_age(time) or ("not seen yet" if seen is None else "lost")
        what = "nothing is drawn" if camera is None else "drawn where it was"
        return TrackingResult(
            time, TumourState.NO_REFERENCE, f"reference {why}: {what}", tracked, motion, camera, reference_time=seen,
            tool_time=None if before is None else before.tool_time,
        )  # fmt: skip

    def _compute_speed(self, reference: Pose, time: float, previous: TrackingResult | None) -> float | None:
        """Return the recent maximum speed of the brain across the image [m/s]; None if not available.

        A maximum is used because, with hand tremor, the speed during one image may exceed the speed between images.
        """
        last = None if previous is None else previous.targets.poses.get(PATIENT)
        if previous is None or last is None or not time > previous.time:
            return None
        scan = self.registration.T_patient_scan @ np.append(self.motion.stage.site.origin, 1.0)
        now, then = ((pose.T_camera_target @ scan)[:2] for pose in (reference, last))
        speed = float(np.linalg.norm(now - then)) / (time - previous.time)
        return max(speed, self.settings.speed_decay ** (time - previous.time) * (previous.image_speed or 0.0))

    def _compute_motion(
        self, tracked: TrackedTargets, reference: Pose, time: float, previous: TrackingResult | None, shutter: float
    ) -> TrackingResult:
        """Compute the brain's motion from the tool's pose relative to the reference; `shutter` adds an error [m]."""
        tool_time, last = (None, None) if previous is None else (previous.tool_time, previous.motion)
        beside = self._find_tool(tracked, reference, time)
        if self.tool is None or beside is None:
            if self.motion.deformer is None:
                state, rest = TumourState.UNKNOWN, self.motion.rest_motion
                return TrackingResult(time, state, UNKNOWN_WARNING, tracked, rest, tool_time=tool_time)
            if tool_time is None or last is None:
                words = f"tool {self._describe_age(time) or 'not seen yet'}: the tumour as in the scan"
                return TrackingResult(time, TumourState.NO_TOOL, words, tracked, self.motion.rest_motion)
            words = f"tool {self._describe_age(time) or 'lost'}: the tumour as {time - tool_time:.1f} s ago"
            return TrackingResult(time, TumourState.NO_TOOL, words, tracked, last, tool_time=tool_time)
        into = np.linalg.inv(self.registration.T_patient_scan)
        pose = into @ beside.T_camera_target @ self.tool.T_cube_tool
        spread = compute_tip_covariance(self.registration, self.tool, beside)
        spread = spread + (self.settings.tip_factor * shutter / BOUND_DEVIATIONS) ** 2 * np.eye(3)
        motion = self.motion.compute_motion(pose, spread, last)
        moved = TumourState.GOOD if motion.distance > 0.0 else TumourState.REST
        state = TumourState.UNSURE if motion.warning else moved if motion.supported else TumourState.UNKNOWN
        words = UNKNOWN_WARNING if state is TumourState.UNKNOWN else motion.warning
        return TrackingResult(time, state, words, tracked, motion, None, pose, spread, tool_time=time)

    def _find_tool(self, tracked_targets: TrackedTargets, reference: Pose, time: float) -> Pose | None:
        """Return the pose of the tool's cube relative to the reference; None if the pose is not available."""
        if self.external is not None:
            return self.external.find_tool_pose(time)
        cube = tracked_targets.poses.get(TOOL)
        return None if cube is None else cube.transform_to(reference)

    def _describe_age(self, time: float) -> str:
        """Describe the age of the external tracker's last poses; empty if current poses exist."""
        age = None if self.external is None else self.external.compute_age(time)
        if self.external is None or age is None:
            return ""
        if outside := self.external.describe_mismatch(time):
            return f"not known, {outside} (see --clock)"
        return f"stale, no pose for {age:.1f} s" if np.isfinite(age) else "not seen yet by the other tracker"

    def _compute_bound(
        self, reference: Pose, centroid: np.ndarray, motion: BrainMotion, shutter: float
    ) -> tuple[float, dict[str, float]]:
        """Compute the error bound [m] of the tumour's `centroid` (3,) [m] across the line of sight, by source."""
        place, beside = self.registration.transform_point(centroid)
        at, tracked = reference.transform_point(place)
        turned = reference.T_camera_target[:3, :3]
        registered = turned @ beside @ turned.T
        camera = None
        if self.intrinsic_covariance is not None and (self.external is None or self.external.mount is None):
            corners = build_patient_reference().faces[0].corners
            camera = compute_calibration_error(
                self.tracker.camera, reference.T_camera_target, corners, place, self.intrinsic_covariance
            )
        seen = tracked + registered + (0.0 if camera is None else camera)
        parts = {
            "tracking": compute_error_radius(tracked, at),
            **({} if camera is None else {"camera": compute_error_radius(camera, at)}),
            "registration": compute_error_radius(registered, at),
            "tool": motion.tool_error,
            "model": motion.model_error,
            **({"shutter": shutter} if self.calibration.readout > 0.0 else {}),
        }
        return float(np.linalg.norm([compute_error_radius(seen, at), motion.error, shutter])), parts


def describe_large_error(error_bound: float) -> str:
    """Return the warning that an error bound [m] is too large for a reliable position."""
    return f"the place is known to {1e3 * error_bound:.0f} mm only: do not rely on it"


def compute_tip_covariance(registration: Registration, tool: TrackedTool, tool_pose: Pose) -> np.ndarray:
    """Compute the covariance (3, 3) [m^2] of a tool tip in the scan, from pose, tool calibration and registration."""
    T = registration.T_patient_scan
    arm, tracked = tool_pose.transform_point(tool.T_cube_tool[:3, 3])
    turned = tool_pose.T_camera_target[:3, :3]
    _, registered = registration.transform_point((arm - T[:3, 3]) @ T[:3, :3])
    whole = tracked + turned @ tool.tip_covariance @ turned.T + registered
    return T[:3, :3].T @ whole @ T[:3, :3]


def compute_error_radius(covariance: np.ndarray, view_direction: np.ndarray) -> float:
    """Return the 95 % radius [m] of an error with covariance (3, 3) [m^2], across a direction of view (3,)."""
    ray = view_direction / np.linalg.norm(view_direction)
    plane = np.eye(3) - np.outer(ray, ray)
    largest = float(np.linalg.eigvalsh(plane @ covariance @ plane)[-1])
    return float(np.sqrt(chi2.ppf(LEVEL, 2) * max(largest, 0.0)))

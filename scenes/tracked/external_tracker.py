"""Poses of tool and reference from an external tracker, at image times and in camera coordinates."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.image_sequences import REMEDY, NamedImage, read_video
from ar.tracking.pose import Pose, PoseStatus, TrackedTargets, Tracker
from ar.tracking.pose_stream import Clock, PoseStream, estimate_clock_offset
from ar.tracking.rigid import build_cross_matrices, to_rotation_vectors
from ar.tracking.synthetic_images import read_time_stamp
from ar.tracking.targets import build_patient_reference, build_tool_cube, list_targets
from sim.errors import InputError
from sim.runtime.outside_files import wrap_errors

from .agreement import Agreement
from .pose_file import TrackedPose

REST_POSE = Pose(np.eye(4), np.zeros((6, 6)), 0.0, 1 << 16)
"""Pose of the camera in its own coordinate system."""
# Time between poses and an image beyond which they belong to another clock or another recording [s].
MAX_TIME_GAP = 1.0


def track_images(
    images: Iterable[NamedImage], calibration: Calibration, body: str, reference: str
) -> Iterator[TrackedPose]:
    """Yield for each image the pose of `body` relative to `reference`; each is "tool", "patient", "board" or "camera".

    Raises
    ------
    ValueError
        The images do not have the size of the calibration.
    """
    targets = {each.name: each for each in list_targets()}
    wanted = [each for each in (body, reference) if each != "camera"]
    tracker = Tracker(calibration.build_camera(np.eye(4)), tuple(targets[name] for name in wanted))
    state: TrackedTargets | None = None
    for picture in images:
        begun = time.perf_counter()
        state = tracker.track(picture.grey, state)
        verdict, pose, lacks = _select_pose(state, wanted)
        if pose is not None and body == "camera":
            pose = REST_POSE.transform_to(pose)
        yield TrackedPose(picture.time, verdict, pose, time.perf_counter() - begun, lacks)


def track_video(path: Path, calibration: Calibration, body: str, reference: str, rate: float) -> Iterator[TrackedPose]:
    """Yield the pose of `body` relative to `reference` (tool, patient, board or camera) for each image of a video.

    Times are the time stamps in the images, or else the times of the video; `rate` [1/s] is that of an image folder.

    Raises
    ------
    InputError
        The input is not readable, or the size of the images differs from the calibration.
    """
    count = 0
    with wrap_errors(path, "a video", REMEDY):
        try:
            for row in track_images(map(_set_stamped_time, read_video(path, rate)), calibration, body, reference):
                count += 1
                yield row
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{path}: holds no image. {REMEDY}")


def _set_stamped_time(image: NamedImage) -> NamedImage:
    """Return an image with the time of its time stamp; without a stamp, the image is unchanged."""
    stamp = read_time_stamp(image.grey)
    return image if stamp is None else replace(image, time=stamp)


def _select_pose(state: TrackedTargets, names: list[str]) -> tuple[PoseStatus, Pose | None, str]:
    """Return status, pose of the first target (relative to the second, if any) and name of a missing target."""
    for name in names:
        if name not in state.poses:
            return state.statuses[name], None, name
    pose, *others = (state.poses[name] for name in names)
    return PoseStatus.GOOD, pose.transform_to(others[0]) if others else pose, ""


@dataclass(frozen=True, eq=False)
class CameraMount:
    """Mounting of the camera: its pose in the coordinate system of the tracker or of a tracked body.

    Parameters
    ----------
    T_body_camera
        Transform (4, 4) [m] from the camera to the body to which the camera is fixed.
    covariance
        Covariance (6, 6) of a translation [m] and a small rotation [rad] of the camera, in the axes of the body.
    poses
        Tracked poses of the body; None: the body is the tracker itself.
    """

    T_body_camera: np.ndarray
    covariance: np.ndarray
    poses: PoseStream | None = None


@dataclass(frozen=True, eq=False)
class ExternalTracker:
    """External tracker: poses of tool and reference, clock offset, and mounting of the camera.

    Parameters
    ----------
    tool_poses, reference_poses
        Poses of the tool and of the patient's reference.
    clock
        Time offset between the clocks of the tracker and the images.
    mount
        Mounting of the camera; None: the images determine the camera's pose relative to the printed reference.
    """

    tool_poses: PoseStream
    reference_poses: PoseStream
    clock: Clock = field(default_factory=Clock)
    mount: CameraMount | None = None

    def find_tool_pose(self, time: float) -> Pose | None:
        """Return the tool's pose relative to the reference at an image's time [s]; None if a pose is missing."""
        return self._interpolate_pose(time, self._interpolate_tool)

    def find_reference_pose(self, time: float) -> Pose | None:
        """Return the reference's pose in camera coordinates at an image's time [s]; None if a pose is missing."""
        return self._interpolate_pose(time, self._locate_in_camera)

    @property
    def swapped_tracker(self) -> ExternalTracker:
        """External tracker with the poses of tool and reference exchanged."""
        return replace(self, tool_poses=self.reference_poses, reference_poses=self.tool_poses)

    def compare_targets(self, time: float, observed_poses: Mapping[str, Pose], agreement: Agreement) -> Agreement:
        """Compare the poses with printed targets visible in the image at a time [s]; return the updated `agreement`.

        `observed_poses`: target poses in camera coordinates, by name. Without a `mount`, only the tool's poses can be
        compared, relative to the visible reference.
        """
        reference, tool = (observed_poses.get(target().name) for target in (build_patient_reference, build_tool_cube))
        if self.mount is None:
            body, other = self.find_tool_pose(time), self.swapped_tracker.find_tool_pose(time)
            if tool is None or reference is None or body is None:
                return agreement
            return agreement.add_image(build_tool_cube().name, tool.transform_to(reference), body, other)
        body, other = self.find_reference_pose(time), self.swapped_tracker.find_reference_pose(time)
        for each, target, a, b in (("patient", reference, body, other), ("tool", tool, other, body)):
            agreement = agreement if target is None or a is None else agreement.add_image(each, target, a, b)
        return agreement

    @property
    def pose_streams(self) -> dict[str, PoseStream]:
        """Pose streams by body: "tool", "patient", and "camera" if a tracked body carries the camera."""
        camera = {} if self.mount is None or self.mount.poses is None else {"camera": self.mount.poses}
        return {"tool": self.tool_poses, "patient": self.reference_poses, **camera}

    def describe_mismatch(self, time: float) -> str:
        """Describe the first body whose poses all begin after or end before an image's time [s]; empty if none does."""
        for name, stream in self.pose_streams.items():
            at = stream.to_stream_time(time + self.clock.offset)
            first, last = stream.times[[0, -1]].tolist()
            if at < first - MAX_TIME_GAP:
                return f"the {name}'s poses begin {first - at:.1f} s after this image"
            if at > last + MAX_TIME_GAP:
                return f"the {name}'s poses end {at - last:.1f} s before this image"
        return ""

    def compute_age(self, time: float) -> float | None:
        """Return the age [s] of the oldest last pose at an image's time [s]; None if all current poses exist."""
        time = time + self.clock.offset
        missing = [each.compute_age(time) for each in self.pose_streams.values() if each.interpolate(time) is None]
        return max(missing) if missing else None

    def _interpolate_pose(self, time: float, pose_at: Callable[[float], Pose | None]) -> Pose | None:
        """Return `pose_at`'s pose at an image's time [s]; its covariance includes motion during the clock error."""
        time, error = time + self.clock.offset, self.clock.error
        pose = pose_at(time)
        if pose is None or error == 0.0:
            return pose
        other = pose_at(time - error) or pose_at(time + error)
        if other is None:
            return None
        T, U = pose.T_camera_target, other.T_camera_target
        step = np.concatenate([U[:3, 3] - T[:3, 3], to_rotation_vectors(U[None, :3, :3] @ T[:3, :3].T)[0]])
        return Pose(T, pose.covariance + np.outer(step, step), pose.residual, pose.corners)

    def _interpolate_tool(self, time: float) -> Pose | None:
        tool, patient = self.tool_poses.interpolate(time), self.reference_poses.interpolate(time)
        return None if tool is None or patient is None else tool.transform_to(patient)

    def _locate_in_camera(self, time: float) -> Pose | None:
        assert self.mount is not None
        patient, poses = self.reference_poses.interpolate(time), self.mount.poses
        body = Pose(np.eye(4), np.zeros((6, 6)), 0.0, 0) if poses is None else poses.interpolate(time)
        if patient is None or body is None:
            return None
        beside = patient.transform_to(body)
        T_camera_body = np.linalg.inv(self.mount.T_body_camera)
        arm = beside.T_camera_target[:3, 3] - self.mount.T_body_camera[:3, 3]
        slope = np.block([[-np.eye(3), build_cross_matrices(arm)], [np.zeros((3, 3)), -np.eye(3)]])
        whole = beside.covariance + slope @ self.mount.covariance @ slope.T
        turned = np.kron(np.eye(2), T_camera_body[:3, :3])
        return Pose(T_camera_body @ beside.T_camera_target, turned @ whole @ turned.T, 0.0, 0)


def estimate_video_clock(
    images: Iterable[NamedImage], calibration: Calibration, tool_poses: PoseStream, reference_poses: PoseStream
) -> Clock:
    """Estimate the time offset between the tracker and a video that shows the printed cube and reference.

    Raises
    ------
    ValueError
        See `estimate_clock_offset` and `track_images`.
    """
    film_rows = track_images(images, calibration, build_tool_cube().name, build_patient_reference().name)
    seen = [(row.time, row.pose) for row in film_rows if row.pose is not None]
    times, places = [time for time, _ in seen], [pose.T_camera_target[:3, 3] for _, pose in seen]
    both = [
        (time, pose)
        for time in tool_poses.times.tolist()
        if (pose := ExternalTracker(tool_poses, reference_poses).find_tool_pose(time)) is not None
    ]
    others = [pose.T_camera_target[:3, 3] for _, pose in both]
    if not both:
        raise ValueError("tool and reference have poses at no common time: record both at once.")
    return estimate_clock_offset(
        np.array(times), np.array(places), np.array([time for time, _ in both]), np.array(others)
    )

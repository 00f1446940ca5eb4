"""Tool and reference as another tracker has them, at the times of the pictures and where the camera sees them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.drawn import read_stamp
from ar.tracking.pictures import GIVE, Named, film_of
from ar.tracking.pose import Pose, Tracked, Tracker, Verdict
from ar.tracking.pose_stream import Clock, PoseStream, clock_by_motion
from ar.tracking.rigid import cross_matrices, turn_vectors
from ar.tracking.targets import all_targets, patient_reference, tool_cube
from sim.errors import InputError
from sim.runtime.outside_files import read_as

from .agreement import Agreement
from .pose_file import TrackedRow

AT_REST = Pose(np.eye(4), np.zeros((6, 6)), 0.0, 1 << 16)
"""The camera in its own frame."""
# Poses that begin or end so far from a picture [s] are of another clock, or of another time.
FAR = 1.0


def rows_of(film: Iterable[Named], calibration: Calibration, body: str, frame: str) -> Iterator[TrackedRow]:
    """A row for each picture: of `body` (tool, patient, board, camera) in the `frame` of one of them that is seen.

    Raises
    ------
    ValueError
        Pictures of another size than the camera was calibrated at.
    """
    targets = {each.name: each for each in all_targets()}
    wanted = [each for each in (body, frame) if each != "camera"]
    tracker = Tracker(calibration.camera(np.eye(4)), tuple(targets[name] for name in wanted))
    state: Tracked | None = None
    for picture in film:
        begun = time.perf_counter()
        state = tracker.track(picture.grey, state)
        verdict, pose, lacks = _known(state, wanted)
        if pose is not None and body == "camera":
            pose = AT_REST.seen_from(pose)
        yield TrackedRow(picture.time, verdict, pose, time.perf_counter() - begun, lacks)


def followed(path: Path, calibration: Calibration, body: str, frame: str, rate: float) -> Iterator[TrackedRow]:
    """A row for each picture: of `body` (tool, patient, board, camera) in the `frame` of one of them that is seen.

    Times are those that pictures hold, or else those of the film.

    Raises
    ------
    InputError
        What cannot be read, and pictures of another size than the camera was calibrated at.
    """
    count = 0
    with read_as(path, "a film", GIVE):
        try:
            for row in rows_of(map(_at_its_time, film_of(path, rate)), calibration, body, frame):
                count += 1
                yield row
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{path}: holds no picture. {GIVE}")


def _at_its_time(picture: Named) -> Named:
    """A picture with the time that it holds, if it holds one."""
    stamp = read_stamp(picture.grey)
    return picture if stamp is None else replace(picture, time=stamp)


def _known(state: Tracked, wanted: list[str]) -> tuple[Verdict, Pose | None, str]:
    """The pose of the first target, beside the second if there are two; else what is known of the one that lacks."""
    for name in wanted:
        if name not in state.poses:
            return state.verdicts[name], None, name
    pose, *others = (state.poses[name] for name in wanted)
    return Verdict.GOOD, pose.seen_from(others[0]) if others else pose, ""


@dataclass(frozen=True, eq=False)
class Eye:
    """Where the camera is in the tracker's frame.

    Parameters
    ----------
    T_body_camera
        (4, 4) [m]: from the camera to what it is fixed to.
    covariance
        (6, 6) of a shift of the camera [m] and a small turn about it [rad], in the axes of that body.
    body
        The poses of what it is fixed to; None: the tracker's own frame.
    """

    T_body_camera: np.ndarray
    covariance: np.ndarray
    body: PoseStream | None = None


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """Poses of another tracker.

    Parameters
    ----------
    tool, patient
        What it says of the tool and of the patient's reference.
    clock
        By how much its clock differs from that of the pictures.
    eye
        Where the camera is; None: its pictures say where it is beside the printed reference.
    """

    tool: PoseStream
    patient: PoseStream
    clock: Clock = field(default_factory=Clock)
    eye: Eye | None = None

    def beside(self, time: float) -> Pose | None:
        """The tool beside the reference in the picture of a time [s]; None where the poses do not say it."""
        return self._at(time, self._beside)

    def reference(self, time: float) -> Pose | None:
        """The reference in the camera's frame in the picture of a time [s]; None where nobody says it."""
        return self._at(time, self._in_camera)

    @property
    def swapped(self) -> Elsewhere:
        """The same poses with the tool's taken for the reference's."""
        return replace(self, tool=self.patient, patient=self.tool)

    def agreed(self, time: float, seen: Mapping[str, Pose], before: Agreement) -> Agreement:
        """What printed targets that are seen in the picture of a time [s] say of these poses.

        `seen` has the targets in the camera's frame, by name. Where pictures say where the camera is beside the
        reference, the tool's alone can be compared.
        """
        reference, tool = (seen.get(target().name) for target in (patient_reference, tool_cube))
        if self.eye is None:
            body, other = self.beside(time), self.swapped.beside(time)
            if tool is None or reference is None or body is None:
                return before
            return before.seen(tool_cube().name, tool.seen_from(reference), body, other)
        body, other = self.reference(time), self.swapped.reference(time)
        for each, target, a, b in (("patient", reference, body, other), ("tool", tool, other, body)):
            before = before if target is None or a is None else before.seen(each, target, a, b)
        return before

    @property
    def streams(self) -> dict[str, PoseStream]:
        """All poses, by whose they are."""
        camera = {} if self.eye is None or self.eye.body is None else {"camera": self.eye.body}
        return {"tool": self.tool, "patient": self.patient, **camera}

    def outside(self, time: float) -> str:
        """Say whose poses are all far from the picture of a time [s], and by how much; empty: nobody's."""
        for name, stream in self.streams.items():
            at = stream.in_its_day(time + self.clock.offset)
            first, last = stream.times[[0, -1]].tolist()
            if at < first - FAR:
                return f"the {name}'s poses begin {first - at:.1f} s after this picture"
            if at > last + FAR:
                return f"the {name}'s poses end {at - last:.1f} s before this picture"
        return ""

    def age(self, time: float) -> float | None:
        """How old the poses of a picture's time [s] are [s]; None where there are some for it."""
        time = time + self.clock.offset
        missing = [each.age(time) for each in self.streams.values() if each.at(time) is None]
        return max(missing) if missing else None

    def _at(self, time: float, pose_at: Callable[[float], Pose | None]) -> Pose | None:
        """A pose at a picture's time [s]; its covariance has in it how far it moves by the error of the clocks."""
        time, error = time + self.clock.offset, self.clock.error
        pose = pose_at(time)
        if pose is None or error == 0.0:
            return pose
        other = pose_at(time - error) or pose_at(time + error)
        if other is None:
            return None
        T, U = pose.T_camera_target, other.T_camera_target
        step = np.concatenate([U[:3, 3] - T[:3, 3], turn_vectors(U[None, :3, :3] @ T[:3, :3].T)[0]])
        return Pose(T, pose.covariance + np.outer(step, step), pose.residual, pose.corners)

    def _beside(self, time: float) -> Pose | None:
        tool, patient = self.tool.at(time), self.patient.at(time)
        return None if tool is None or patient is None else tool.seen_from(patient)

    def _in_camera(self, time: float) -> Pose | None:
        assert self.eye is not None
        patient = self.patient.at(time)
        body = Pose(np.eye(4), np.zeros((6, 6)), 0.0, 0) if self.eye.body is None else self.eye.body.at(time)
        if patient is None or body is None:
            return None
        beside = patient.seen_from(body)
        T_camera_body = np.linalg.inv(self.eye.T_body_camera)
        arm = beside.T_camera_target[:3, 3] - self.eye.T_body_camera[:3, 3]
        slope = np.block([[-np.eye(3), cross_matrices(arm)], [np.zeros((3, 3)), -np.eye(3)]])
        whole = beside.covariance + slope @ self.eye.covariance @ slope.T
        turned = np.kron(np.eye(2), T_camera_body[:3, :3])
        return Pose(T_camera_body @ beside.T_camera_target, turned @ whole @ turned.T, 0.0, 0)


def clock_of_film(film: Iterable[Named], calibration: Calibration, tool: PoseStream, patient: PoseStream) -> Clock:
    """By how much the tracker's clock differs from that of a film in which printed cube and reference are seen, too.

    Raises
    ------
    ValueError
        As `clock_by_motion` and `rows_of`.
    """
    film_rows = rows_of(film, calibration, tool_cube().name, patient_reference().name)
    seen = [(row.time, row.pose) for row in film_rows if row.pose is not None]
    times, places = [time for time, _ in seen], [pose.T_camera_target[:3, 3] for _, pose in seen]
    both = [(time, pose) for time in tool.times.tolist() if (pose := Elsewhere(tool, patient).beside(time)) is not None]
    others = [pose.T_camera_target[:3, 3] for _, pose in both]
    if not both:
        raise ValueError("tool and reference have poses at no common time: record both at once.")
    return clock_by_motion(np.array(times), np.array(places), np.array([time for time, _ in both]), np.array(others))

"""Tool and reference as another tracker has them, at the times of the pictures and where the camera sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.clocks import Clock, clock_by_motion
from ar.tracking.pictures import Named
from ar.tracking.pose import Pose
from ar.tracking.pose_stream import PoseStream
from ar.tracking.rigid import cross_matrices, turn_vectors
from ar.tracking.targets import patient_reference, tool_cube

from .agreement import Agreement
from .followed import rows_of

# Poses that begin or end so far from a picture [s] are of another clock, or of another time.
FAR = 1.0


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

"""Tool and reference as another tracker has them, at the times of the pictures and where the camera sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.clocks import Clock, clock_by_motion
from ar.tracking.pictures import Named
from ar.tracking.pose import Pose
from ar.tracking.pose_stream import PoseStream
from ar.tracking.rigid import cross_matrices, turn_vectors
from ar.tracking.targets import patient_reference, tool_cube

from ...script.followed import rows_of


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

    def age(self, time: float) -> float | None:
        """How old the poses of a picture's time [s] are [s]; None where there are some for it."""
        time = time + self.clock.offset
        streams = [self.tool, self.patient, *([self.eye.body] if self.eye is not None and self.eye.body else [])]
        missing = [each.age(time) for each in streams if each.at(time) is None]
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

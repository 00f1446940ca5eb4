"""Received transforms of tool, reference, camera and scan, by their OpenIGTLink device names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from .frame import NAME_BYTES, TICKS, BadMessageError

ROTATION_TOLERANCE = 2e-3  # Tolerance of axes from length 1 and right angles: matrices have single precision.
MAX_COORDINATE = 10.0  # Largest coordinate of a tracked body [m].
# Difference from the last time stamp above which an earlier one means that the clock was set back [s].
MAX_CLOCK_STEP = 5.0
# Number of earlier transforms of one name that are kept, for images that arrive later than the poses around them.
MAX_KEPT_TRANSFORMS = 32


@dataclass(frozen=True)
class TransformNames:
    """Device names of the received transforms; a transform AToB maps coordinates in frame A to frame B.

    If a transform of tool or camera has the same frame B as `reference`, B is the tracker. Otherwise, also for names of
    another form, B is the patient's reference.
    """

    tool: str = "StylusTipToReference"
    reference: str = "ReferenceToTracker"
    camera: str = "CameraToReference"
    registration: str = "ReferenceToRas"

    @cached_property
    def by_wire(self) -> dict[str, str]:
        """Complete names, by name as shortened in a message."""
        return {name[:NAME_BYTES].strip(): name for name in (self.tool, self.reference, self.camera, self.registration)}

    def is_tracker_transform(self, name: str) -> bool:
        """Return True if the transform with this name maps to the tracker's frame."""
        tracker = self.reference.rpartition("To")[2]
        return "To" in self.reference and name.rpartition("To")[2] == tracker


@dataclass(frozen=True, eq=False)
class ReceivedTransform:
    """Received transform T (4, 4) [m] with its time stamp, time of arrival [s], and number of the sending client."""

    T: np.ndarray
    stamp: int
    arrived: float
    sender: int


@dataclass(frozen=True, eq=False)
class ReceivedTransforms:
    """Newest transforms, by name.

    Parameters
    ----------
    names
        Names of the accepted transforms.
    max_age
        Maximum age [s] at which the transform of a moving body is used.
    newest, earlier
        Newest transform, and earlier transforms (oldest first), by name.
    """

    names: TransformNames
    max_age: float
    newest: Mapping[str, ReceivedTransform] = field(default_factory=dict)
    earlier: Mapping[str, tuple[ReceivedTransform, ...]] = field(default_factory=dict)

    def add_transform(self, name: str, matrix: np.ndarray, stamp: int, time: float, sender: int) -> ReceivedTransforms:
        """Return a copy with a transform (4, 4) [mm] added, which arrived from a client `sender` at `time` [s].

        Raises
        ------
        BadMessageError
            The matrix is not a rigid transform or marks an invisible body, time stamps do not increase, or another
            client sends the same transform.
        """
        if not matrix[:3, :3].any():
            raise BadMessageError("zeros, which trackers send for invisible bodies")
        T = to_rigid(matrix)
        if name != self.names.registration and np.array_equal(matrix, np.eye(4)):
            raise BadMessageError("the identity, which trackers send for invisible bodies")
        last = self.newest.get(name)
        if last is not None and last.sender != sender and time - last.arrived < self.max_age:
            raise BadMessageError("another client sends it, too")
        if last is not None and last.sender == sender and stamp and name != self.names.registration:
            if stamp == last.stamp:
                raise BadMessageError("the same time stamp again")
            if 0 < last.stamp - stamp < MAX_CLOCK_STEP * TICKS:
                raise BadMessageError("a time stamp before the last one")
        kept = (
            ()
            if last is None or (stamp and stamp < last.stamp)
            else (*self.earlier[name][1 - MAX_KEPT_TRANSFORMS :], last)
        )
        newest = {**self.newest, name: ReceivedTransform(T, stamp, time, sender)}
        return replace(self, newest=newest, earlier={**self.earlier, name: kept})

    def find_relative_transform(self, name: str, time: float) -> ReceivedTransform | str:
        """Return a body's transform to the patient's reference, or the reason why it is unknown at `time` [s]."""
        needed = (name, self.names.reference) if self.names.is_tracker_transform(name) else (name,)
        for each in needed:
            sent = self.newest.get(each)
            if sent is None:
                return f"no {each} yet"
            if (age := time - sent.arrived) > self.max_age:
                return f"no new {each} for {age:.1f} s"
        return self._transform_to_reference(name, self.newest[name])

    def list_transforms(self, name: str) -> tuple[ReceivedTransform, ...]:
        """Return a body's transforms to the patient's current reference, oldest first; all are from the last sender."""
        newest = self.newest[name]
        every = (*self.earlier.get(name, ()), newest)
        return tuple(self._transform_to_reference(name, sent) for sent in every if sent.sender == newest.sender)

    def _transform_to_reference(self, name: str, body: ReceivedTransform) -> ReceivedTransform:
        if not self.names.is_tracker_transform(name):
            return body
        reference = self.newest[self.names.reference]
        arrived = min(body.arrived, reference.arrived)
        return replace(body, T=np.linalg.inv(reference.T) @ body.T, arrived=arrived)


def check_tracker_status(metadata: Mapping[str, str]) -> None:
    """Check that the metadata of a transform contain no tracker status other than OK.

    Raises
    ------
    BadMessageError
        The tracker does not see the body: a status, as sent by 3D Slicer and PLUS, is not OK.
    """
    for key, value in metadata.items():
        if key.casefold().endswith("status") and value.casefold() != "ok":
            raise BadMessageError(f"not seen by its tracker: {key} {value[:20]}")


def to_rigid(matrix: np.ndarray) -> np.ndarray:
    """Convert a matrix (4, 4) [mm] to a rigid transform (4, 4) [m] with an orthogonal rotation in double precision.

    Raises
    ------
    BadMessageError
        The matrix is not finite, mirrors, scales or shears, or shifts by more than 10 m.
    """
    if not np.isfinite(matrix).all():
        raise BadMessageError("a matrix that is not finite")
    axes, shift = matrix[:3, :3], 1e-3 * matrix[:3, 3]
    if np.linalg.det(axes) < 0.0:
        raise BadMessageError("a matrix that mirrors: one frame is left-handed")
    if np.abs(axes.T @ axes - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise BadMessageError("a matrix that scales or shears: give a rotation and a shift in mm")
    if np.abs(shift).max() > MAX_COORDINATE:
        raise BadMessageError("a shift of more than 10 m: give mm")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_matrix(axes).as_matrix(), shift
    return T

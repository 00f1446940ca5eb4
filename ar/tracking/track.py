"""Targets followed from picture to picture: they are looked for where they were, and everywhere when lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..optics.camera import Camera
from .pose import FEWEST, Pose, Verdict, pose_of
from .targets import Corners, Detector, Target, window_round

# Round what a target covered, such a share of its size is looked at, and so many pixels at least.
AROUND, MARGIN = 0.4, 32.0
# A pose that is so many pictures old says nothing of the next; what is lost is looked for in every so many pictures.
STALE, SEARCHED = 5, 3


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one picture says of each target, by name.

    Parameters
    ----------
    number
        Of the picture.
    verdicts
        What is known.
    poses
        Of those that are certain.
    last
        The pose (4, 4) that was certain last, and the picture's number, of all that were.
    """

    number: int
    verdicts: Mapping[str, Verdict]
    poses: Mapping[str, Pose]
    last: Mapping[str, tuple[np.ndarray, int]]


@dataclass(frozen=True, eq=False)
class Tracker:
    """Follows targets in the pictures of one camera.

    Parameters
    ----------
    camera
        As calibrated; where it stands is of no account.
    targets
        Of different names, and with different markers.
    """

    camera: Camera
    targets: tuple[Target, ...]
    _detector: Detector = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", replace(self.camera, T_camera_world=np.eye(4)))
        object.__setattr__(self, "_detector", Detector(self.targets))

    def track(self, grey: np.ndarray, before: Tracked | None = None) -> Tracked:
        """Where the targets are in a picture (H, W) uint8, of the camera's size; `before` is what the last one said.

        Raises
        ------
        ValueError
            A picture of another size or kind.
        """
        demand_picture(grey, self.camera.width, self.camera.height)
        number = 0 if before is None else before.number + 1
        last = {} if before is None else {k: each for k, each in before.last.items() if number - each[1] <= STALE}
        found = self._seen(grey, number, last)
        verdicts, poses = {}, {}
        for target in self.targets:
            expected = last[target.name][0] if target.name in last else None
            verdicts[target.name], pose = pose_of(self.camera, target, found.get(target.name), expected)
            if pose is not None:
                poses[target.name] = pose
                last[target.name] = pose.T_camera_target, number
        return Tracked(number, verdicts, poses, last)

    def _seen(self, grey: np.ndarray, number: int, last: Mapping[str, tuple[np.ndarray, int]]) -> dict[str, Corners]:
        """Corners of targets where they were; of those that left, and now and then of the lost, everywhere."""
        found: dict[str, Corners] = {}
        for target in self.targets:
            if target.name in last:
                T, outline = last[target.name][0], target.outline
                window = window_round(self.camera, outline @ T[:3, :3].T + T[:3, 3], AROUND, MARGIN)
                seen = None if window is None else self._detector.seen_in(target, grey, window)
                found |= {target.name: seen} if seen is not None and len(seen.points) >= FEWEST else {}
        missing = [target.name for target in self.targets if target.name not in found]
        just_left = any(last.get(name, (None, -2))[1] == number - 1 for name in missing)
        if missing and (just_left or number % SEARCHED == 0):
            found |= self._detector.seen(grey, missing)
        return found


def demand_picture(grey: np.ndarray, width: int, height: int) -> None:
    """Refuse a picture that a camera of so many pixels does not take.

    Raises
    ------
    ValueError
        A picture of another size or kind.
    """
    if grey.shape != (height, width) or grey.dtype != np.uint8:
        raise ValueError(
            f"the picture is {' x '.join(map(str, grey.shape[::-1]))} of {grey.dtype}, and the camera takes "
            f"{width} x {height} grey pixels of 8 bits: calibrate it at this size."
        )

"""Whether another tracker's poses agree with the printed targets that the pictures show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ar.tracking.pose import Pose

# A printed target is no farther from the body that carries it [m], and stays where it is on it but for this [m].
FARTHEST, LOOSE = 0.2, 5e-3
# Poses of targets that are less well known say nothing [m]; so many pictures are remembered, and so many are enough.
KNOWN, KEPT, FEWEST = 2e-3, 30, 4
# Bodies that lie so many times nearer to the target when the two files change places are swapped, beyond this [m].
NEARER, BESIDE = 3.0, 0.02
# Of the pictures that are remembered, so many in 100 count: one in ten may be misread.
MOST = 90.0
REMEDY = "see --poses and --clock"


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where printed targets were seen beside the bodies that carry them, in the last pictures.

    Parameters
    ----------
    places
        By the target's name: places in the body's frame (n, 3) [m].
    doubts
        By the target's name: what the last picture that shows it says against the poses; empty: nothing.
    """

    places: Mapping[str, np.ndarray] = field(default_factory=dict)
    doubts: Mapping[str, str] = field(default_factory=dict)

    @property
    def doubt(self) -> str:
        """What speaks against the poses, in words; empty: nothing."""
        return next(filter(None, self.doubts.values()), "")

    def seen(self, name: str, target: Pose, body: Pose, swapped: Pose | None) -> Agreement:
        """With one more picture: a target as it is seen, its body as poses have it, and as the other's file has it.

        All are in one frame. A target whose place is not well known says nothing.
        """
        if np.linalg.eigvalsh(target.covariance[:3, :3])[-1] > KNOWN**2:
            return self
        place, other = (None if each is None else _beside(target, each) for each in (body, swapped))
        assert place is not None
        places = np.vstack([self.places.get(name, np.empty((0, 3))), place])[-KEPT:]
        doubt = _doubt(name, places, other)
        return Agreement({**self.places, name: places}, {**self.doubts, name: doubt})


def _beside(target: Pose, body: Pose) -> np.ndarray:
    """Where a target is in a body's frame (3,) [m]."""
    return (np.linalg.inv(body.T_camera_target) @ target.T_camera_target)[:3, 3]


def _doubt(name: str, places: np.ndarray, swapped: np.ndarray | None) -> str:
    """What places (n, 3) [m] of a target on its body say against the poses; the newest is the last."""
    away = float(np.linalg.norm(places[-1]))
    if swapped is not None and away > BESIDE and NEARER * np.linalg.norm(swapped) < away:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: are the two files of --poses swapped?"
    if away > FARTHEST:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: {REMEDY}"
    moved = np.percentile(np.linalg.norm(places - np.median(places, axis=0), axis=1), MOST)
    if len(places) >= FEWEST and moved > LOOSE:
        return f"the {name}'s target moves by {1e3 * moved:.0f} mm on the body that its poses have: {REMEDY}"
    return ""

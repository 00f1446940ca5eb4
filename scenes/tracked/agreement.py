"""Consistency of an external tracker's poses with the printed targets that are visible in the images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ar.tracking.pose import Pose


@dataclass(frozen=True)
class AgreementSettings:
    """Settings of `Agreement`."""

    max_target_distance: float = 0.2  # Largest distance of a printed target from the body that carries it [m].
    max_target_motion: float = 5e-3  # Largest motion of a printed target on the body that carries it [m].
    max_pose_deviation: float = 2e-3  # Largest standard deviation of a usable target pose [m].
    max_kept_images: int = 30  # Number of last images kept.
    min_images: int = 4  # Minimum number of images for a warning about a moving target.
    swap_ratio: float = 3.0  # Factor by which bodies must be closer to the target with swapped files for a warning.
    # Smallest distance of a target from its body for a warning about swapped files [m].
    min_swap_distance: float = 0.02
    motion_percentile: float = 90.0  # Percentile of the kept images that is used [%]: one in ten may be misread.


REMEDY = "see --poses and --clock"  # Remedy in warnings.


@dataclass(frozen=True, eq=False)
class Agreement:
    """Positions of printed targets, observed in the last images, relative to the tracked bodies that carry them.

    Parameters
    ----------
    positions
        Positions (n, 3) [m] of a target in the coordinate system of its body, by target name.
    inconsistencies
        Inconsistency between the poses and the last image of a target, by target name; empty text: consistent.
    settings
        Limits of the warnings.
    """

    positions: Mapping[str, np.ndarray] = field(default_factory=dict)
    inconsistencies: Mapping[str, str] = field(default_factory=dict)
    settings: AgreementSettings = AgreementSettings()

    @property
    def inconsistency(self) -> str:
        """Description of the first inconsistency between poses and images; empty if all targets are consistent."""
        return next(filter(None, self.inconsistencies.values()), "")

    def add_image(self, name: str, target_pose: Pose, body_pose: Pose, swapped_pose: Pose | None) -> Agreement:
        """Return the agreement with a new image: target pose, its body's pose, and this pose if the files were swapped.

        All poses are in the same coordinate system. A target whose position is too uncertain is skipped.
        """
        if np.linalg.eigvalsh(target_pose.covariance[:3, :3])[-1] > self.settings.max_pose_deviation**2:
            return self
        bodies = body_pose, swapped_pose
        place, other = (None if each is None else _compute_target_position(target_pose, each) for each in bodies)
        assert place is not None
        places = np.vstack([self.positions.get(name, np.empty((0, 3))), place])[-self.settings.max_kept_images :]
        doubt = _describe_doubt(name, places, other, self.settings)
        return Agreement({**self.positions, name: places}, {**self.inconsistencies, name: doubt}, self.settings)


def _compute_target_position(target: Pose, body: Pose) -> np.ndarray:
    """Return the position (3,) [m] of a target in the coordinate system of a body."""
    return (np.linalg.inv(body.T_camera_target) @ target.T_camera_target)[:3, 3]


def _describe_doubt(name: str, positions: np.ndarray, swapped: np.ndarray | None, settings: AgreementSettings) -> str:
    """Describe the inconsistency of positions (n, 3) [m] of a target on its body, oldest first; empty if consistent."""
    away = float(np.linalg.norm(positions[-1]))
    nearer = swapped is not None and settings.swap_ratio * np.linalg.norm(swapped) < away
    if nearer and away > settings.min_swap_distance:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: are the two files of --poses swapped?"
    if away > settings.max_target_distance:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: {REMEDY}"
    moved = np.percentile(np.linalg.norm(positions - np.median(positions, axis=0), axis=1), settings.motion_percentile)
    if len(positions) >= settings.min_images and moved > settings.max_target_motion:
        return f"the {name}'s target moves by {1e3 * moved:.0f} mm on the body that its poses have: {REMEDY}"
    return ""

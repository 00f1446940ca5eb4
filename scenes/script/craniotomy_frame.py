"""Open cortex with a coordinate frame: contact points and directions of tools."""

from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import OpenCortex, Place, open_cortex

from .tool_paths import Touch

# Radius of the drape's hole over that of the largest circle of open cortex: its rim hides the mesh's ragged border.
HOLE_RATIO = 0.98


@dataclass(frozen=True, eq=False)
class CraniotomyFrame(OpenCortex):
    """Open cortex with a coordinate frame, contact points and directions of tools."""

    def compute_reach(self, radius: float) -> float:
        """Return the maximum distance [m] of a tool of this `radius` from the axis, as limited by the bone."""
        return max(0.0, HOLE_RATIO * self.clearance - radius)

    def clip_to_opening(self, point: np.ndarray, radius: float) -> np.ndarray:
        """Move a point (3,) [m] towards the axis, to where the bone stops a tool of this `radius` [m]."""
        arm = point - self.origin
        aside = arm - (arm @ self.axis) * self.axis
        length = float(np.linalg.norm(aside))
        return point - max(0.0, 1.0 - self.compute_reach(radius) / max(length, np.finfo(float).tiny)) * aside

    def find_contact(self, x: float, y: float, radius: float) -> Place:
        """Return the material point of the open cortex nearest to the place (x, y) [m] of its tangent plane.

        A tool of this `radius` [m] stays inside the opening: a place beyond is moved to where the bone stops the tool.
        """
        return self.find_nearest(self.clip_to_opening(self.origin + x * self.right + y * self.up, radius))

    def compute_direction(self, touch: Touch) -> np.ndarray:
        """Compute the unit direction (3,) of a touch's force: inwards, with the touch's tilt."""
        along = self.axis + np.tan(touch.tilt[0]) * self.right + np.tan(touch.tilt[1]) * self.up
        return along / np.linalg.norm(along)

    # Former names, for one release.
    reach, within, contact, direction = compute_reach, clip_to_opening, find_contact, compute_direction


def build_craniotomy_frame(anatomy: Anatomy) -> CraniotomyFrame:
    """Return the frame of an anatomy's open cortex.

    Raises
    ------
    InputError
        An anatomy without open cortex.
    """
    frame = open_cortex(anatomy)
    return CraniotomyFrame(anatomy, frame.origin, frame.axis, frame.right, frame.up)

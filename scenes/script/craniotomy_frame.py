"""Coordinate system of a craniotomy, with contact points and directions of tools."""

from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import OpenCortex, Place, open_cortex

from .tool_paths import Touch

# Radius of the drape's hole over that of the largest circle of open cortex: its rim hides the mesh's ragged border.
HOLE_RATIO = 0.98


@dataclass(frozen=True, eq=False)
class CraniotomyFrame(OpenCortex):
    """Open cortex with the coordinate system of its craniotomy; computes contact points and directions of tools."""

    def compute_reach(self, radius: float) -> float:
        """Return the maximum distance [m] from the axis that bone permits a tool of this `radius` [m]."""
        return max(0.0, HOLE_RATIO * self.clearance - radius)

    def clip_to_opening(self, point: np.ndarray, radius: float) -> np.ndarray:
        """Return a point (3,) [m], moved towards the axis if bone would stop a tool of this `radius` [m] before it."""
        arm = point - self.origin
        aside = arm - (arm @ self.axis) * self.axis
        length = float(np.linalg.norm(aside))
        return point - max(0.0, 1.0 - self.compute_reach(radius) / max(length, np.finfo(float).tiny)) * aside

    def find_contact(self, x: float, y: float, radius: float) -> Place:
        """Return the material point of the open cortex that is nearest to the position (x, y) [m] in the tangent plane.

        A tool of this `radius` [m] stays inside the craniotomy: see `clip_to_opening`.
        """
        return self.find_nearest(self.clip_to_opening(self.origin + x * self.right + y * self.up, radius))

    def compute_direction(self, touch: Touch) -> np.ndarray:
        """Compute the unit direction (3,) of the force of a tool input: the inward axis, tilted by `touch.tilt`."""
        along = self.axis + np.tan(touch.tilt[0]) * self.right + np.tan(touch.tilt[1]) * self.up
        return along / np.linalg.norm(along)

    # Former names, for one release.
    reach, within, contact, direction = compute_reach, clip_to_opening, find_contact, compute_direction


def build_craniotomy_frame(anatomy: Anatomy) -> CraniotomyFrame:
    """Build the coordinate system of an anatomy's craniotomy.

    Raises
    ------
    InputError
        The anatomy has no open cortex.
    """
    frame = open_cortex(anatomy)
    return CraniotomyFrame(anatomy, frame.origin, frame.axis, frame.right, frame.up)

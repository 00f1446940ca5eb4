"""Poses of a ball as pushes: where on the cortex at rest it is deepest, and how deep.

A tool's pose is tracked where its force is not known. A ball without friction presses along the surface's normal, and
its answer depends on where its middle is, not on how it came there: place and depth determine it. To learners a depth
is what a force is: both are nothing where nothing moves.
"""

from __future__ import annotations

import numpy as np

from sim.errors import InputError
from sim.loads import Loads, Pushed, Touching

from .cortex_patch import Patch

# A middle so near to the surface [m] has the surface's normal.
ON_IT = 1e-6


def indented(loads: Loads, radius: float, patch: Patch) -> Pushed:
    """One ball's poses as pushes: point (B, 3) [m] nearest to its middle, depth along the normal for force [m], radius.

    A ball that touches nothing has no depth.

    Raises
    ------
    InputError
        Loads that are not the poses of one tool.
    """
    touching = loads.only(Touching)
    if touching is None or touching.pose.shape[1] != 1:
        names = ", ".join(type(cause).__name__ for cause in loads.causes) or "none"
        raise InputError(
            f"the loads have the causes {names}, but this model was trained on the poses of one ball: give `Touching` "
            "of one tool alone, or ask the finite elements."
        )
    pose = touching.pose[:, 0]
    middle = pose[:, :3, 3] + radius * pose[:, :3, 2]
    point = patch.skin.nearest(middle, np.full(len(middle), np.inf))[0]
    inward, away = patch.normal_near(point), point - middle
    # Positive where the middle is still outside.
    distance = np.copysign(np.linalg.norm(away, axis=1), np.einsum("bi,bi->b", away, inward))
    near = np.abs(distance) < ON_IT
    direction = np.where(near[:, None], inward, away / np.where(near, 1.0, distance)[:, None])
    return Pushed(point, np.maximum(radius - distance, 0.0)[:, None] * direction, np.full(len(pose), radius))

"""Poses of a tool that moves along its shaft: each is solved from the pose before it, not from the undeformed state."""

from dataclasses import replace

import numpy as np

from sim.deformation import Deformation, join_deformations
from sim.fem import Fem
from sim.loads import Loads, Touching

STROKE_LENGTH = 8
"""Number of poses that a data set has in a stroke, if its tool moves as in a scene."""
MAX_SIDEWAYS = 1e-6  # Largest sideways motion within a stroke [m], and largest change of an entry of the rotation.


def solve_strokes(fem: Fem, loads: Loads) -> Deformation:
    """Solve poses (B rows); a solver of one load at a time starts a pose that continues a stroke from the pose before.

    The tool passes the same states in both cases; a stroke of 8 depths takes a quarter of the time.
    """
    touching = loads.get(Touching)
    if touching is None or fem.batch > 1:
        return fem.deform(loads)
    results: list[Deformation] = []
    for row, continues in enumerate(find_continuations(touching.pose)):
        start = results[-1] if continues and results[-1].outcome[0].good else None
        results.append(fem.deform(loads.select(np.array([row])), start))
    return join_deformations([replace(result, warm={}) for result in results])


def find_continuations(pose: np.ndarray) -> np.ndarray:
    """Return a mask (B,) of the poses (B, tools, 4, 4) [m] that lie deeper than the pose before, along the shafts."""
    motion, shaft = np.diff(pose[..., :3, 3], axis=0), pose[:-1, :, :3, 2]
    advance = -np.sum(motion * shaft, axis=-1)
    sideways = np.abs(motion + advance[..., None] * shaft).max(axis=-1)
    turn = np.abs(np.diff(pose[..., :3, :3], axis=0)).max(axis=(-1, -2))
    straight = (advance > 0.0) & (sideways <= MAX_SIDEWAYS) & (turn <= MAX_SIDEWAYS)
    return np.concatenate([[False], straight.all(axis=-1)])

"""Sampling of tool poses of a scene: positions on the open cortex, and depths, as a user can set on the page."""

import numpy as np
from scipy.stats import qmc

from sim.errors import InputError
from sim.loads import Loads, Touching
from sim.tools import BuiltIn
from surrogate.data.strokes import STROKE_LENGTH

from .craniotomy_frame import CraniotomyFrame
from .scene import Scene
from .tool_paths import Touch

DEPTH_MARGIN = 1.05  # Largest sampled depth over the largest depth of the script.


def sample_scene_poses(scene: Scene, site: CraniotomyFrame, count: int, seed: int) -> tuple[BuiltIn, Loads]:
    """Return the shape of a scene's tool, and `count` sampled poses: positions uniform by area, 8 depths at each.

    Load i depends only on the seed and on i: positions are a Halton sequence, shifted by the seed (Cranley, Patterson
    1976, SIAM J. Numer. Anal. 13:904-914), and the 8 depths of a position are in 8 equal depth intervals.

    Raises
    ------
    InputError
        The scene does not move a ball, capsule or blade into the tissue by a prescribed pose.
    """
    deepest = DEPTH_MARGIN * scene.max_depth
    shape = None if scene.tool is None else scene.tool.shape
    if scene.tool is None or not isinstance(shape, BuiltIn) or not scene.posed or deepest <= 0.0:
        raise InputError(
            f"the scene {scene.name} moves no ball, capsule or blade by pose into the tissue: name one that does."
        )
    source = np.random.Generator(np.random.Philox(key=seed))
    places = qmc.Halton(2, scramble=False).random(-(-count // STROKE_LENGTH)) + source.random(2)
    share = np.repeat(places % 1.0, STROKE_LENGTH, axis=0)[:count]
    radius, angle = site.compute_reach(scene.tool.radius) * np.sqrt(share[:, 0]), 2.0 * np.pi * share[:, 1]
    depth = deepest * (np.arange(count) % STROKE_LENGTH + source.random(count)) / STROKE_LENGTH
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    touches = (Touch(*one[:2], depth=one[2]) for one in np.column_stack([x, y, depth]).tolist())
    return shape, Loads((Touching(np.stack([scene.compute_pose(site, touch) for touch in touches])[:, None]),))

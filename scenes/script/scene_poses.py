"""Sampling of a scene's tool poses, as a user sets them on the page: position on the cortex, and depth."""

import numpy as np
from scipy.stats import qmc

from sim.errors import InputError
from sim.loads import Loads, Touching
from sim.tools import BuiltIn

from .craniotomy_frame import CraniotomyFrame
from .scene import Scene
from .tool_paths import Touch

DEPTHS = 8  # Number of depths at each place.
DEPTH_MARGIN = 1.05  # Largest sampled depth over the largest depth of the script.


def sample_scene_poses(scene: Scene, site: CraniotomyFrame, count: int, seed: int) -> tuple[BuiltIn, Loads]:
    """Sample `count` poses of a scene's tool, and return both: places uniform by area, each with eight depths.

    Load i depends on the seed and on i alone: places are a Halton sequence, shifted by the seed (Cranley, Patterson
    1976, SIAM J. Numer. Anal. 13:904-914), and each eighth of the depths has one pose of a place.

    Raises
    ------
    InputError
        A scene without a ball, capsule or blade that is moved by its pose into the tissue.
    """
    deepest = DEPTH_MARGIN * scene.max_depth
    shape = None if scene.tool is None else scene.tool.shape
    if scene.tool is None or not isinstance(shape, BuiltIn) or not scene.posed or deepest <= 0.0:
        raise InputError(
            f"the scene {scene.name} moves no ball, capsule or blade by pose into the tissue: name one that does."
        )
    source = np.random.Generator(np.random.Philox(key=seed))
    places = qmc.Halton(2, scramble=False).random(-(-count // DEPTHS)) + source.random(2)
    share = np.repeat(places % 1.0, DEPTHS, axis=0)[:count]
    radius, angle = site.compute_reach(scene.tool.radius) * np.sqrt(share[:, 0]), 2.0 * np.pi * share[:, 1]
    depth = deepest * (np.arange(count) % DEPTHS + source.random(count)) / DEPTHS
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    touches = (Touch(*one[:2], depth=one[2]) for one in np.column_stack([x, y, depth]).tolist())
    return shape, Loads((Touching(np.stack([scene.compute_pose(site, touch) for touch in touches])[:, None]),))

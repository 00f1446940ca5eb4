"""A spatula is laid on the cortex, draws it aside, and is held there while the tissue relaxes under it."""

from dataclasses import replace

import numpy as np

from sim.effects import Bonded, Elasticity, Held, Retraction
from sim.material import BRAIN

from ..script.scene import Scene
from ..script.tool import Blade
from ..script.tool_paths import lay

BLADE = Blade()  # Default blade.
# A Prony series of brain in vitro: Miller, Chinzei 2002, J. Biomech. 35:483-490.
RELAXING_BRAIN = replace(BRAIN, prony=((0.45, 0.5), (0.365, 50.0)))

SCENE = Scene(
    "retract",
    __doc__ or "",
    lay(depth=8e-3, tilt=np.radians(30.0), rise=1.5),
    duration=4.0,
    effects=(Elasticity(RELAXING_BRAIN), Held(), Bonded(), Retraction(BLADE.shape)),
    tool=BLADE,
)

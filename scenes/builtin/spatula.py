"""A brain spatula presses the cortex aside, holds, and lets go; the tumour under it moves by 4 mm."""

import numpy as np

from sim.effects import Bonded, Elasticity, Held, Retraction

from ..script.scene import Scene
from ..script.tool import Blade
from ..script.tool_paths import lay
from ..script.viewpoint import Appearance, Viewpoint

# Its mean pressure is 1.7 kPa (13 mmHg). At 20 mmHg for 15 minutes one of six rat brains was damaged, at 30 mmHg five:
# Rosenorn, Diemer 1985, J. Neurosurg. 63:608-611.
BLADE = Blade(width=0.020, length=0.030, edge=2e-3)

SCENE = Scene(
    "spatula",
    __doc__ or "",
    lay(depth=10e-3, tilt=np.radians(20.0), rise=1.5, at=(-0.004, 0.0), hold=1.0),
    duration=4.0,
    effects=(Elasticity(), Held(), Bonded(), Retraction(BLADE.shape)),
    tool=BLADE,
    viewpoint=Viewpoint(width=800, height=600, field=1.0),
    look=Appearance(vessels=1),
)

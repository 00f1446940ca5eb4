"""A suction tube with a ball of cotton touches the cortex near the tumour and draws it aside."""

import numpy as np

from ..script.scene import Scene
from ..script.tool_paths import draw
from ..script.viewpoint import Appearance

SCENE = Scene(
    "draw",
    __doc__ or "",
    draw(force=0.25, tilt=np.radians(38.0), rise=1.2, hold=0.8, at=(-0.008, 0.0)),
    duration=4.2,
    look=Appearance(natural=True, instrument="suction"),
)

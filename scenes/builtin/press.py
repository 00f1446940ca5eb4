"""A palpation ball presses on the cortex over the tumour, holds, and lets go."""

import numpy as np

from ..script.scene import Scene
from ..script.tool_paths import press
from ..script.viewpoint import Viewpoint

# View close enough to show a motion of 1.6 mm: the outlines of scan and present are a dozen pixels apart.
VIEW = Viewpoint(fov=np.radians(13.0), width=800, height=600)

SCENE = Scene("press", __doc__ or "", press(force=0.3, rise=1.5, hold=0.5), duration=4.0, viewpoint=VIEW)

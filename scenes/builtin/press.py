"""A palpation ball presses on the cortex over the tumour, holds, and lets go."""

from ..script.scene import Scene
from ..script.tool_paths import press
from ..script.viewpoint import Viewpoint

VIEW = Viewpoint(width=800, height=600)

SCENE = Scene("press", __doc__ or "", press(force=0.3, rise=1.5, hold=0.5), duration=4.0, viewpoint=VIEW)

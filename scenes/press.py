"""A palpation ball presses on the cortex over the tumour, holds, and lets go."""

from .paths import press
from .scene import Scene

SCENE = Scene("press", __doc__ or "", press(force=0.25, rise=1.5, hold=0.5), duration=4.0)

"""A palpation ball slides across the cortex over the tumour with steady force."""

from dataclasses import replace

from ..script.scene import Scene
from ..script.tool_paths import slide
from ..script.viewpoint import NATURAL_APPEARANCE

SCENE = Scene(
    "slide",
    __doc__ or "",
    slide(0.2, start=(-0.012, -0.006), end=(0.012, 0.006), seconds=3.0),
    duration=4.0,
    look=replace(NATURAL_APPEARANCE, instrument="forceps"),
)

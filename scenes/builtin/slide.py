"""Forceps with a ball of cotton slide across the cortex over the tumour with steady force."""

from ..script.scene import Scene
from ..script.tool_paths import slide
from ..script.viewpoint import Appearance

SCENE = Scene(
    "slide",
    __doc__ or "",
    slide(0.2, start=(-0.012, -0.006), end=(0.012, 0.006), seconds=3.0),
    duration=4.0,
    look=Appearance(natural=True, instrument="forceps"),
)

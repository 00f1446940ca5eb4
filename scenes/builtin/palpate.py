"""A palpation ball, moved by hand, sinks into the cortex over the tumour and slides along it."""

from sim.effects import Bonded, Elasticity, Held, ToolContact

from ..script.scene import PALPATION, Scene
from ..script.tool_paths import palpate

SCENE = Scene(
    "palpate",
    __doc__ or "",
    palpate(depth=4e-3, start=(-0.009, 0.004), end=(0.009, -0.004), seconds=2.4),
    duration=4.0,
    effects=(Elasticity(), Held(), Bonded(), ToolContact((PALPATION.shape,))),
)

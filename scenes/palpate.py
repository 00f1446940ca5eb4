"""A palpation ball, moved by hand, sinks into the cortex over the tumour and slides along it."""

from sim.effects import Elasticity, Held, Slide, ToolContact

from .paths import palpate
from .scene import PALPATION, Scene

SCENE = Scene(
    "palpate",
    __doc__ or "",
    palpate(depth=4e-3, start=(-0.009, 0.004), end=(0.009, -0.004), seconds=2.4),
    duration=4.0,
    effects=(Elasticity(), Held(), Slide(), ToolContact((PALPATION.shape,))),
)

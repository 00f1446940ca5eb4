"""Heartbeat and breath lift the open brain under a ball that rests on it."""

from sim.effects import Bonded, Elasticity, Held, Pulsation, ToolContact

from ..script.scene import PALPATION, Scene
from ..script.tool_paths import lay
from ..script.viewpoint import Appearance

SCENE = Scene(
    "pulsation",
    __doc__ or "",
    lay(depth=0.5e-3, rise=1.0),
    duration=6.0,
    effects=(Elasticity(), Held(), Bonded(), Pulsation(), ToolContact((PALPATION.shape,))),
    look=Appearance(natural=True, instrument="forceps"),
)

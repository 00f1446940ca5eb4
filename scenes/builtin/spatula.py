"""A spatula presses the cortex down over the tumour, holds it, and lets go: most of the motion reaches the tumour."""

from sim.effects import Bonded, Elasticity, Held, Retraction

from ..script.scene import Scene
from ..script.tool import Blade
from ..script.tool_paths import lay
from ..script.viewpoint import Viewpoint

BLADE = Blade(width=16e-3, length=28e-3, edge=2e-3)

SCENE = Scene(
    "spatula",
    __doc__ or "",
    lay(depth=10e-3, rise=1.5, hold=1.0),
    duration=4.0,
    effects=(Elasticity(), Held(), Bonded(), Retraction(BLADE.shape)),
    tool=BLADE,
    viewpoint=Viewpoint(width=800, height=600, field=1.0),
    deformer="gp-spatula",
)

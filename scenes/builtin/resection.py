"""The fluid has partly drained; the tumour is debulked through a corridor, and what is left of it settles."""

from sim.effects import Elasticity, Gravity, Held, SkullContact
from sim.named_tissues import MATERIALS

from ..script.debulking import Debulking
from ..script.head_pose import build_drainage
from ..script.scene import Scene

DRAINED_TISSUE = MATERIALS["drained"].tissue  # Drained tissue: fluid leaves it in minutes.

SCENE = Scene(  # Without weight nothing would move: the model is free of stress in the scan.
    "resection",
    __doc__ or "",
    duration=5.0,
    effects=(Elasticity(DRAINED_TISSUE), Held(), SkullContact(), Gravity()),
    tool=None,
    lying=build_drainage(1.5, level=0.3),
    surgery=Debulking(times=(2.0, 2.7, 3.4, 4.1)),
)

"""The dura is open and half of the fluid drains: the brain sinks, and sinks otherwise when the head is turned."""

import numpy as np

from sim.effects import Elasticity, Gravity, Held, SkullContact
from sim.named_tissues import MATERIALS

from ..script.head_pose import build_drained_turn
from ..script.scene import Scene

DRAINED_TISSUE = MATERIALS["drained"].tissue  # Drained tissue: fluid leaves it in minutes.

SCENE = Scene(
    "brain_shift",
    __doc__ or "",
    duration=6.0,
    effects=(Elasticity(DRAINED_TISSUE), Held(), SkullContact(), Gravity()),
    tool=None,
    lying=build_drained_turn(drain_time=3.0, pause_time=0.5, turn_time=2.0, angle=np.radians(30.0), level=0.5),
)

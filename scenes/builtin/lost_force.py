"""A tool presses with unknown force. The tumour position is estimated from the tool pose and the cortex."""

from sim.anatomy import TUMOUR_LABEL
from sim.effects import Bonded, Elasticity, Held, ToolForce
from sim.material import Material

from ..script.observation_models import PointObservation
from ..script.scene import Bounds, Scene
from ..script.tool import Probe
from ..script.tool_paths import press
from ..script.viewpoint import Appearance, Viewpoint

BRAIN = Material("linear", young=1800.0, poisson=0.49)  # Softer than the default, unknown to the estimate.
TUMOUR = Material("linear", young=3200.0, poisson=0.49)  # Stiffer than the brain, unknown to the estimate.

SCENE = Scene(
    "lost_force",
    __doc__ or "",
    press(force=0.35, rise=1.5, hold=0.5, at=(-0.004, 0.003)),
    tool=Probe(radius=10e-3),  # under a smaller one tetrahedra are inverted
    duration=4.0,
    effects=(Elasticity(BRAIN, {TUMOUR_LABEL: TUMOUR}), Held(), Bonded(), ToolForce()),
    observation_model=PointObservation(),
    viewpoint=Viewpoint(width=800, height=600),
    look=Appearance(natural=True, instrument="forceps"),
    # The tumour moves little more than the rigid error: in four frames 43 % of the motion is removed.
    bounds=Bounds(overlap=0.75, error=2e-3, removed=0.3),
)

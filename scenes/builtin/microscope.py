"""Under a microscope the brain sinks and a tool presses; the tumour position is estimated from its images alone."""

from sim.anatomy import TUMOUR_LABEL
from sim.effects import Elasticity, Gravity, Held, Slide, ToolForce
from sim.material import Material

from ..script.head_pose import build_drainage
from ..script.observation_models import StereoObservation
from ..script.scene import Bounds, Scene
from ..script.tool import Probe
from ..script.tool_paths import Touch, press
from ..script.viewpoint import PLAIN_APPEARANCE, Viewpoint

BRAIN = Material("neo-hookean", young=1800.0, poisson=0.45)  # Softer than the default, unknown to the estimate.
TUMOUR = Material("neo-hookean", young=3200.0, poisson=0.45)  # Stiffer than the brain, unknown to the estimate.

# Press of the tool: it waits in the air, and presses after the brain has sunk.
PRESS = press(force=0.15, rise=0.8, hold=0.4, at=(-0.004, 0.008))


def press_late(time: float) -> Touch:
    """Return the tool input at a time [s]."""
    return PRESS(time - 2.0)


SCENE = Scene(
    "microscope",
    __doc__ or "",
    press_late,
    tool=Probe(radius=7e-3),
    duration=4.0,
    effects=(Elasticity(BRAIN, {TUMOUR_LABEL: TUMOUR}), Held(), Slide(), Gravity(), ToolForce()),
    lying=build_drainage(2.0, level=0.2),
    observation_model=StereoObservation(),
    viewpoint=Viewpoint(width=800, height=600, eye="left", field=1.0),
    look=PLAIN_APPEARANCE,  # the stereo images of the FEM surface itself
    bounds=Bounds(overlap=0.7, error=3e-3, drawn=2.5, removed=0.5),
)

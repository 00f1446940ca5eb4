"""Fluid drains and the brain sinks; where the tumour is now is found from a hundred points of the cortex alone."""

from sim.anatomy import TUMOUR_LABEL
from sim.effects import Elasticity, Gravity, Held, Slide
from sim.material import Material

from ..script.head_pose import build_drainage
from ..script.observation_models import PointObservation
from ..script.scene import Bounds, Scene
from ..script.viewpoint import Viewpoint

BRAIN = Material("neo-hookean", young=1800.0, poisson=0.45)  # Softer than the default, unknown to the estimate.
TUMOUR = Material("neo-hookean", young=3200.0, poisson=0.45)  # Stiffer than the brain, unknown to the estimate.

SCENE = Scene(
    "sag",
    __doc__ or "",
    duration=4.0,
    effects=(Elasticity(BRAIN, {TUMOUR_LABEL: TUMOUR}), Held(), Slide(), Gravity()),
    tool=None,
    lying=build_drainage(3.0, level=0.2),
    observation_model=PointObservation(),
    viewpoint=Viewpoint(width=800, height=600),
    # The truth's dashed outline is drawn with an error of up to 0.4 pixels at a live solution: in one frame that
    # makes 2.2.
    bounds=Bounds(overlap=0.7, error=3e-3, drawn=2.5, removed=0.5),
)

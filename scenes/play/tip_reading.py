"""Distance from tool tip to tumour, displayed at the tool, with its error bound."""

from dataclasses import dataclass

import numpy as np

from ar.overlay.hud import format_millimetres
from sim.anatomy import Anatomy
from sim.bodies.tip_distance import build_tip_gauge
from sim.deformation import Deformation, Deformer
from sim.loads import Loads, Pushed, Touching
from surrogate.model.guarded import find_first_model

from ..script.tool import Instrument, Probe


@dataclass(frozen=True)
class TipDistance:
    """Distance from tool tip to tumour, with its error bound.

    Parameters
    ----------
    distance
        Distance [m].
    bound
        95 % bound on the difference from the FEM distance [m]; None if not available.
    """

    distance: float
    bound: float | None

    def __str__(self) -> str:
        return format_millimetres(self.distance, self.bound)


def predict_tip_distance(
    deformer: Deformer, loads: Loads, solution: Deformation, tool: Instrument | None, drawn_distance: float
) -> TipDistance | None:
    """Predict the distance from tip to tumour in the first load case of a solution.

    Returns None unless the only active tool is a ball. FEM gives no bound; a trained model none outside its range.

    Parameters
    ----------
    drawn_distance
        Distance [m] between the drawn tip and the drawn tumour.
    """
    if _get_ball(loads, tool) is None:
        return None
    model = find_first_model(deformer, solution)
    if model is None:
        return TipDistance(drawn_distance, None)
    found = model.predict_distance(loads, solution, np.array([drawn_distance]))
    promised = float(found.bound[0, 0])
    kept = solution.outcome[0].good and promised < float("inf")
    return TipDistance(float(found.distance[0]), promised if kept else None)


def measure_tip_distance(
    anatomy: Anatomy, loads: Loads, solution: Deformation, tool: Instrument | None, lift: float
) -> TipDistance | None:
    """Measure the distance from tip to tumour in any solution, without bound; None unless the only tool is a ball.

    Parameters
    ----------
    solution
        Solution that contains at least the open cortex and the tumour.
    lift
        Height [m] above the tissue at which an idle pushing tool is drawn.

    Raises
    ------
    InputError
        The solution does not contain the open cortex or the tumour.
    """
    ball = _get_ball(loads, tool)
    if ball is None:
        return None
    found = build_tip_gauge(anatomy).compute_distances(loads, solution.displacement, solution.nodes, ball.shape, lift)
    return TipDistance(float(found[0]), None)


def _get_ball(loads: Loads, tool: Instrument | None) -> Probe | None:
    """Return `tool` if it is a ball and the only tool that pushes or moves; else None."""
    alone = len(loads.get_all(Pushed)) + len(loads.get_all(Touching)) == 1
    return tool if alone and isinstance(tool, Probe) else None

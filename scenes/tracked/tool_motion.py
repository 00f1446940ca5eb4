"""Brain motion under a tracked tool: deformation computed from the tool's pose, with its error."""

from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation, Deformer
from sim.errors import InputError
from sim.loads import Loads, Touching
from surrogate.model.guarded import find_first_model
from surrogate.model.learned import Learned

from ..play.frame_text import describe_outcome
from ..play.stage import Stage
from ..script.uncertainty import BOUND_DEVIATIONS

NO_ERROR_WARNING = "the model states no error: do not rely on it"  # Warning in the image.
# Warning in the image.
TOO_DEEP_WARNING = "the tool is farther inside the brain than the model knows: do not rely on it"


@dataclass(frozen=True, eq=False)
class BrainMotion:
    """Deformed state of the brain, with its error.

    Parameters
    ----------
    positions
        Positions (V, 3) [m] of all mesh vertices; vertices without a computed displacement are undeformed.
    supported
        True if a deformer computed the deformation.
    distance
        Mean displacement of the tumour's surface from the scan [m].
    model_error, tool_error
        95 % bounds [m] on the error of a tumour vertex due to the model, and due to the error of the tool's position.
    warning
        Reason for the image why the motion is unreliable; empty if the motion is reliable.
    solution
        Solution from which the next solve may start.
    """

    positions: np.ndarray
    supported: bool = False
    distance: float = 0.0
    model_error: float = 0.0
    tool_error: float = 0.0
    warning: str = ""
    solution: Deformation | None = None

    @property
    def error(self) -> float:
        """95 % bound on the error of the motion due to model and tool position [m]."""
        return float(np.hypot(self.model_error, self.tool_error))


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Model of the brain's deformation for tool poses; without a deformer the brain stays undeformed."""

    stage: Stage
    deformer: Deformer | None = None

    @property
    def rest_motion(self) -> BrainMotion:
        """Undeformed state of the brain."""
        return BrainMotion(self.stage.anatomy.mesh.nodes)

    def compute_motion(
        self, T_scan_tool: np.ndarray, tip_covariance: np.ndarray, previous: BrainMotion | None = None
    ) -> BrainMotion:
        """Compute the state of the brain for a tool pose (4, 4) [m] with the tip's error covariance (3, 3) [m^2].

        The influence of the tip's error is computed by a second solve with the tool 1.96 standard deviations deeper.
        """
        if self.deformer is None:
            return self.rest_motion
        deviation = float(np.sqrt(max(np.linalg.eigvalsh(tip_covariance)[-1], 0.0)))
        deeper = T_scan_tool.copy()
        deeper[:3, 3] += BOUND_DEVIATIONS * deviation * self.stage.site.axis
        start = None if previous is None else previous.solution
        try:
            result, further = self._solve_poses(T_scan_tool, deeper, start)
        except InputError:
            return BrainMotion(self.rest_motion.positions, warning=TOO_DEEP_WARNING)
        vertices, rest = self.stage.tumour_vertices, self.rest_motion.positions
        moved, beyond = (each.restrict(vertices).displacement[0] for each in (result, further))
        positions, doubt = rest.copy(), describe_outcome(result.outcome[0])
        positions[result.nodes] += result.displacement[0]
        model = find_first_model(self.deformer, result)
        bound = 0.0 if model is None else float(result.bound[0, 0])
        if model is not None and not np.isfinite(bound):
            bound, doubt = (model.bound, doubt) if np.isfinite(model.bound) else (0.0, doubt or NO_ERROR_WARNING)
        return BrainMotion(
            positions,
            True,
            float(np.linalg.norm(moved, axis=1).mean()),
            bound,
            float(np.linalg.norm(beyond - moved, axis=1).max()),
            doubt,
            result,
        )

    def _solve_poses(
        self, pose: np.ndarray, deeper_pose: np.ndarray, start: Deformation | None
    ) -> tuple[Deformation, Deformation]:
        """Compute the solutions for `pose` and `deeper_pose`; FEM starts from the solution `start`."""
        assert self.deformer is not None
        if isinstance(self.deformer, Learned):
            loads = Loads((Touching(np.stack([pose, deeper_pose])[:, None]),))
            both = self.deformer.deform(loads, at=self.stage.drawn_vertices)
            return both.select(np.array([0])), both.select(np.array([1]))
        first = self.deformer.deform(Loads((Touching(pose[None, None]),)), start=start)
        return first, self.deformer.deform(Loads((Touching(deeper_pose[None, None]),)), start=first)

"""How the brain lies under a tracked tool: what a model or finite elements make of its pose, and how far off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation, Deformer
from sim.errors import InputError
from sim.loads import Loads, Touching
from surrogate.model.guarded import answering
from surrogate.model.learned import Learned

from ..play.frame_text import doubt_of
from ..play.stage import Stage
from ..script.uncertainty import DEVIATIONS

UNBOUND = "the model states no error: do not rely on it"
REFUSED = "the tool is farther inside the brain than the model knows: do not rely on it"


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the brain is.

    Parameters
    ----------
    positions
        Of all mesh vertices (V, 3) [m]; of those that are not drawn, at rest.
    known
        Whether anybody answered for the tool's pose.
    moved
        Mean distance of the tumour's surface from where the scan has it [m].
    model, tool
        At 95 %: how far a vertex may be off by the model, and by the error of the tool's place [m].
    doubt
        Why it may not be relied on, in words for the picture; empty where it may.
    answer
        What was answered, from which the next one may start.
    """

    positions: np.ndarray
    known: bool = False
    moved: float = 0.0
    model: float = 0.0
    tool: float = 0.0
    doubt: str = ""
    answer: Deformation | None = None

    @property
    def error(self) -> float:
        """Of the motion at 95 %, as far as it is known [m]."""
        return float(np.hypot(self.model, self.tool))


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """What a deformer answers for the poses of a stage's tool; without a deformer the brain stays as in the scan."""

    stage: Stage
    deformer: Deformer | None = None

    @property
    def rest(self) -> Motion:
        """The brain as in the scan."""
        return Motion(self.stage.anatomy.mesh.nodes)

    def under(self, T_scan_tool: np.ndarray, tip_covariance: np.ndarray, before: Motion | None = None) -> Motion:
        """The brain under a tool at a pose (4, 4) [m], whose tip is off with a covariance (3, 3) [m^2].

        How far that moves the tumour is found by a second answer, for a tool that is 1.96 standard deviations deeper.
        """
        if self.deformer is None:
            return self.rest
        deviation = float(np.sqrt(max(np.linalg.eigvalsh(tip_covariance)[-1], 0.0)))
        deeper = T_scan_tool.copy()
        deeper[:3, 3] += DEVIATIONS * deviation * self.stage.site.axis
        start = None if before is None else before.answer
        try:
            answer, further = self._answers(T_scan_tool, deeper, start)
        except InputError:
            return Motion(self.rest.positions, doubt=REFUSED)
        vertices, rest = self.stage.tumour_vertices, self.rest.positions
        moved, beyond = (each.at(vertices).displacement[0] for each in (answer, further))
        positions, doubt = rest.copy(), doubt_of(answer.outcome[0])
        positions[answer.nodes] += answer.displacement[0]
        model = answering(self.deformer, answer)
        bound = 0.0 if model is None else float(answer.bound[0, 0])
        if model is not None and not np.isfinite(bound):
            bound, doubt = (model.bound, doubt) if np.isfinite(model.bound) else (0.0, doubt or UNBOUND)
        return Motion(
            positions,
            True,
            float(np.linalg.norm(moved, axis=1).mean()),
            bound,
            float(np.linalg.norm(beyond - moved, axis=1).max()),
            doubt,
            answer,
        )

    def _answers(
        self, pose: np.ndarray, deeper: np.ndarray, start: Deformation | None
    ) -> tuple[Deformation, Deformation]:
        """Of both poses; finite elements start from the last one."""
        assert self.deformer is not None
        if isinstance(self.deformer, Learned):
            both = self.deformer.deform(Loads((Touching(np.stack([pose, deeper])[:, None]),)), at=self.stage.nodes)
            return both.rows(np.array([0])), both.rows(np.array([1]))
        first = self.deformer.deform(Loads((Touching(pose[None, None]),)), start=start)
        return first, self.deformer.deform(Loads((Touching(deeper[None, None]),)), start=first)

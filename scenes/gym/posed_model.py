"""A tool that is moved, as a model that was trained on its poses answers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.errors import InputError
from sim.loads import Loads, Touching
from surrogate.model.guarded import tool_pressure
from surrogate.model.learned import Learned

from .pressed_model import Hertz
from .touched import Asked, Touched


@dataclass(frozen=True, eq=False)
class PosedModel:
    """Asks a model of the tool's poses for motion, force and bound; a blade goes on from where it was.

    The pressure under a ball is that of Hertz under its force; under a blade it is the highest of `tool_pressure`.

    Parameters
    ----------
    model
        Trained on poses of the tool.
    ball
        The tool, if it is one.
    """

    model: Learned
    ball: Hertz | None

    def answer(self, asked: Sequence[Asked]) -> list[Touched]:
        """As `Answers.answer`, one after the other. Where the model refuses a pose, tissue stays, and is not good."""
        return [self._answered(each.pose, each.last) for each in asked]

    def _answered(self, pose: np.ndarray, last: Touched | None) -> Touched:
        loads = Loads((Touching(pose[None, None]),))
        try:
            answer = self.model.deform(loads, None if last is None else last.memory)
        except InputError:
            nodes = self.model.nodes
            rest = Touched(np.zeros((len(nodes), 3)), nodes, np.zeros(3), 0.0) if last is None else last
            return replace(rest, good=False, error=float("inf"))
        force = answer.reaction[0, 0, :3]
        if self.ball is None:
            highest = float(tool_pressure(self.model, loads, answer).max())
        else:
            highest = self.ball.pressure(float(np.linalg.norm(force)))
        error = float(answer.bound[0, 0])
        if not np.isfinite(error):
            error = self.model.bound
        return Touched(answer.displacement[0], answer.nodes, force, highest, error=error, memory=answer)

"""A tool that is moved, as finite elements answer it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.contact_pressure import pressure
from sim.deformation import Deformation, joined
from sim.fem import Fem
from sim.loads import Loads, Touching

from .pressed_model import Hertz
from .touched import Asked, Touched


@dataclass(frozen=True, eq=False)
class PosedElements:
    """Finite elements in contact with a rigid tool.

    The pressure under a ball is that of Hertz under its force; under a blade it is the highest of `sim.pressure`.

    Parameters
    ----------
    fem
        Of `ToolContact` with the tool.
    ball
        The tool, if it is one.
    together
        Whether all are answered at once.
    """

    fem: Fem
    ball: Hertz | None
    together: bool = False

    def answer(self, asked: Sequence[Asked]) -> list[Touched]:
        """As `Answers.answer`; those whose episode begins are a batch of their own."""
        found: dict[int, Touched] = {}
        begin = [row for row, each in enumerate(asked) if each.last is None]
        going = [row for row, each in enumerate(asked) if each.last is not None]
        for rows in (begin, going):
            for some in [rows] if self.together and rows else [[row] for row in rows]:
                found |= dict(zip(some, self._answered([asked[row] for row in some]), strict=True))
        return [found[row] for row in range(len(asked))]

    def _answered(self, asked: Sequence[Asked]) -> list[Touched]:
        loads = Loads((Touching(np.stack([each.pose for each in asked])[:, None]),))
        starts = [each.last.memory for each in asked if each.last is not None and each.last.memory is not None]
        answer = self.fem.deform(loads, _stacked(starts) if starts else None)
        force = answer.reaction[:, 0, :3]
        size = np.linalg.norm(force, axis=1)
        if self.ball is not None:
            highest = [self.ball.pressure(float(each)) for each in size]
        else:
            highest = pressure(self.fem, loads, answer).max(axis=1).tolist()
        rows = [answer]
        if len(asked) > 1:
            rows = [replace(answer.rows(np.array([row])), warm={}) for row in range(len(asked))]
        return [
            Touched(row.displacement[0], row.nodes, force[number], highest[number], row.outcome[0].good, memory=row)
            for number, row in enumerate(rows)
        ]


def _stacked(starts: Sequence[Deformation]) -> Deformation:
    return starts[0] if len(starts) == 1 else joined(starts)

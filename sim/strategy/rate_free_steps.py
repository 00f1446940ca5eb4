"""What is left to do where stiffness depends on the step in time and no time passes: nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..deformation import Outcome
from ..discretisation.inverted_elements import Inversion
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from .strategy import Answer


@dataclass(frozen=True, eq=False)
class Still:
    """Stands in for a `Ladder`: what has mass does not move at once, whatever pulls at it, nor do tools."""

    problem: Problem
    inversion: Inversion

    def climb(self, cases: Cases, guesses: Sequence[np.ndarray]) -> Answer:
        """Where the bodies were (3N, B) [m], the last of the guesses; at rest without."""
        device, count = self.problem.device, len(cases.loads)
        u = device.array(guesses[-1]) if guesses else device.zeros(self.problem.rows, count)
        outcome, none = np.full(count, Outcome.CONVERGED, object), np.zeros(count, int)
        return Answer(
            u, outcome, none, np.zeros(count), np.ones(count), self.inversion.count(u), 0, gone=np.zeros(count)
        )

"""Steps in time: which preconditioner serves them, and what is left to do where nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..deformation import Outcome
from ..discretisation.inverted_elements import Inversion
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from .strategy import SolverResult


@dataclass(frozen=True, eq=False)
class NoMotionStep:
    """Stands in for a `Strategy`: what has mass does not move at once, whatever pulls at it, nor do tools."""

    problem: Problem
    inversion: Inversion

    def solve(self, cases: Cases, guesses: Sequence[np.ndarray]) -> SolverResult:
        """Where the bodies were (3N, B) [m], the last of the guesses; at rest without."""
        device, count = self.problem.device, len(cases.loads)
        u = device.array(guesses[-1]) if guesses else device.zeros(self.problem.rows, count)
        outcome, none = np.full(count, Outcome.CONVERGED, object), np.zeros(count, int)
        return SolverResult(
            u, outcome, none, np.zeros(count), np.ones(count), self.inversion.count(u), 0, gone=np.zeros(count)
        )


# Longer steps [s] have the preconditioner of statics. Brain in its skull sways at 1 Hz or faster: beside its stiffness
# inertia is then less than a thousandth.
LONGEST = 8.0
# So many preconditioners are kept: each is as large as that of statics.
KEPT = 3


def quantise(steps: np.ndarray) -> np.ndarray:
    """Return the powers of two (B,) [s] nearest to steps (B,) [s], by ratio.

    Infinite for long steps, zero for none at all.
    """
    within = (steps > 0.0) & (steps < LONGEST)
    powers = np.exp2(np.round(np.log2(np.where(within, steps, 1.0))))
    return np.where(within, powers, np.where(steps > 0.0, np.inf, 0.0))


def group_alike(steps: np.ndarray, most: int) -> list[tuple[float, np.ndarray]]:
    """Batches of at most so many cases, of steps (B,) [s] as good as alike: the step, and the rows (k,) of each."""
    paces = quantise(steps)
    return [
        (float(pace), rows[first : first + most])
        for pace in np.unique(paces)
        for rows in [np.flatnonzero(paces == pace)]
        for first in range(0, len(rows), most)
    ]

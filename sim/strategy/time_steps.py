"""Time steps: grouping by length for preconditioners, and steps of zero length."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..deformation import Outcome
from ..discretisation.inverted_elements import InversionCounter
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from .solver_result import SolverResult


@dataclass(frozen=True, eq=False)
class NoMotionStep:
    """Replacement of a `Strategy` for time steps of zero length, in which neither tissue nor tools move."""

    problem: Problem
    inversion: InversionCounter

    def solve(self, cases: Cases, guesses: Sequence[np.ndarray]) -> SolverResult:
        """Return the last guess (3N, B) [m] unchanged, or the undeformed state without guesses."""
        device, count = self.problem.device, len(cases.loads)
        u = device.upload(guesses[-1]) if guesses else device.allocate(self.problem.rows, count)
        outcome, none = np.full(count, Outcome.CONVERGED, object), np.zeros(count, int)
        return SolverResult(
            u, outcome, none, np.zeros(count), np.ones(count), self.inversion.count(u), 0, path_fraction=np.zeros(count)
        )


# Steps from this length on [s] use the static preconditioner. The brain in its skull oscillates at 1 Hz or faster, so
# that inertia is then less than a thousandth of its stiffness.
MAX_DYNAMIC_STEP = 8.0
MAX_PRECONDITIONERS = 3  # Preconditioners that are cached; each is as large as the static one.


def quantise_time_steps(steps: np.ndarray) -> np.ndarray:
    """Return, for each step (B,) [s], the power of two [s] with the ratio nearest to 1.

    Steps of `MAX_DYNAMIC_STEP` or more become infinite; steps of zero remain zero.
    """
    within = (steps > 0.0) & (steps < MAX_DYNAMIC_STEP)
    powers = np.exp2(np.round(np.log2(np.where(within, steps, 1.0))))
    return np.where(within, powers, np.where(steps > 0.0, np.inf, 0.0))


def group_time_steps(steps: np.ndarray, max_size: int) -> list[tuple[float, np.ndarray]]:
    """Return batches of at most `max_size` cases with about equal steps (B,) [s]: the step, and the cases (k,)."""
    paces = quantise_time_steps(steps)
    return [
        (float(pace), rows[first : first + max_size])
        for pace in np.unique(paces)
        for rows in [np.flatnonzero(paces == pace)]
        for first in range(0, len(rows), max_size)
    ]

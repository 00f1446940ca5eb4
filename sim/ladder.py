"""What is tried for a load, rung by rung: from the start, from rest, in load steps. Batches of cases climb together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .accuracy import Accuracy
from .deformation import Outcome
from .direction import Descent
from .inversion import Inversion
from .newton import find_equilibrium
from .problem import Problem
from .term import Cases

# The first descent has so many outer steps; what it does not bring to its end is left to the second. On CUDA, where
# products with the curvature cost little, the second alone is faster by up to a half.
QUICK, QUICK_ON_CUDA = 20, 0
# Load steps as shares of the load: the first, the least, and what is left of one that failed.
FIRST_STEP, LEAST_STEP, CUT = 1.0 / 4.0, 1.0 / 64.0, 1.0 / 4.0
# The next load step is as long as lets expect so many outer steps; one that takes more than the most is too long.
STEP_OUTER, MOST_STEP_OUTER = 8, 15
# Load steps end when the batch has spent so many times the linear iterations that one outer step may take.
PATIENCE = 4


@dataclass(frozen=True, eq=False)
class Answer:
    """u (3N, B) [m] on the host; (B,): outcomes, outer steps, residuals, shares of the load reached, inverted tets.

    And the linear iterations of the batch.
    """

    u: np.ndarray
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    reached: np.ndarray
    inverted: np.ndarray
    linear_iterations: int

    @property
    def good(self) -> np.ndarray:
        """(B,) bool."""
        return np.array([outcome.good for outcome in self.outcome], bool)

    def rows(self, index: np.ndarray) -> Answer:
        """Some of the cases (k,)."""
        return Answer(
            self.u[:, index],
            self.outcome[index],
            self.iterations[index],
            self.residual[index],
            self.reached[index],
            self.inverted[index],
            0,
        )

    def put(self, index: np.ndarray, other: Answer) -> None:
        """Write the answer of other cases over some of these (k,); outer steps add up."""
        self.u[:, index] = other.u
        self.iterations[index] += other.iterations
        for name in ("outcome", "residual", "reached", "inverted"):
            getattr(self, name)[index] = getattr(other, name)


@dataclass(frozen=True, eq=False)
class Ladder:
    """The rungs: each takes what the one before it did not bring to equilibrium.

    quick, thorough
        Descents: the first for a few outer steps, the second for the rest.
    inversion
        Of the discretisation that the problem is posed on.
    accuracy
        Tolerance and budgets.
    """

    quick: Descent
    thorough: Descent
    inversion: Inversion
    accuracy: Accuracy

    def climb(self, problem: Problem, cases: Cases, guess: np.ndarray) -> Answer:
        """The equilibria of B cases, from guess (3N, B) [m].

        A start that lies inside out is left alone, and so is a state that does to which a start led: a body turned
        over or collapsed may be in equilibrium with itself. From rest such a state is taken as the load's doing.
        """
        started = guess.any(axis=0)
        astray = started & (self.inversion.count(guess) > 0)
        answer = self._whole(problem, cases, np.where(astray, 0.0, guess))
        again = np.flatnonzero(started & ~astray & np.where(answer.good, answer.inverted > 0, self._lost(answer)))
        if len(again):
            astray[again] = True
            answer.put(again, self._whole(problem, cases.rows(again), np.zeros((len(guess), len(again)))))
        answer.outcome[astray & answer.good] = Outcome.CONVERGED_ANEW
        lost = np.flatnonzero(self._lost(answer))
        if len(lost):
            answer.put(lost, self._in_steps(problem, cases.rows(lost), answer.rows(lost)))
        return answer

    def _lost(self, answer: Answer) -> np.ndarray:
        """Which cases (B,) another rung may save: at round-off none is nearer to equilibrium."""
        return ~answer.good & (answer.outcome != Outcome.ROUND_OFF) & (self.accuracy.steps > 0)

    def _whole(self, problem: Problem, cases: Cases, guess: np.ndarray) -> Answer:
        """The whole load at once: the quick descent, and the thorough one from where that ended.

        Motions that are imposed are left to the thorough one: it knows how the free nodes follow them. So is a small
        budget: its steps lead farther.
        """
        problem.begin(cases)
        _, imposed = problem.gap(problem.device.array(guess))
        quick = QUICK_ON_CUDA if problem.device.on_cuda else QUICK
        if imposed.any() or self.accuracy.outer <= quick:
            quick = 0
        return self._attempt(problem, cases, guess, ((self.quick, quick), (self.thorough, self.accuracy.outer - quick)))

    def _attempt(
        self, problem: Problem, cases: Cases, guess: np.ndarray, budgets: tuple[tuple[Descent, int], ...]
    ) -> Answer:
        """Descents, each with its outer steps, one after the other on the cases that the last did not finish."""
        count = guess.shape[1]
        u, left = guess.copy(), np.arange(count)
        outcome, residual = np.full(count, Outcome.BUDGET, object), np.full(count, np.inf)
        iterations, linear_iterations = np.zeros(count, int), 0
        for descent, outer in budgets:
            if len(left) == 0 or outer == 0:
                continue
            problem.begin(cases.rows(left))
            found = find_equilibrium(problem, descent, u[:, left], replace(self.accuracy, outer=outer))
            u[:, left], outcome[left], residual[left] = found.u, found.outcome, found.residual
            iterations[left] += found.iterations
            linear_iterations += found.linear_iterations
            left = left[[ended in (Outcome.BUDGET, Outcome.STALLED) for ended in found.outcome]]
        good = np.array([ended.good for ended in outcome], bool)
        return Answer(u, outcome, iterations, residual, good.astype(float), self.inversion.count(u), linear_iterations)

    def _in_steps(self, problem: Problem, cases: Cases, failed: Answer) -> Answer:
        """From rest, the load raised in steps that grow and shrink; the equilibrium under the largest share found."""
        count = len(cases.loads)
        answer = replace(failed, iterations=np.zeros(count, int))
        u, step, spent = np.zeros_like(failed.u), np.full(count, FIRST_STEP), 0
        for _ in range(self.accuracy.steps):
            live = np.flatnonzero((answer.reached < 1.0) & (step >= LEAST_STEP))
            if len(live) == 0 or spent > PATIENCE * self.accuracy.inner:
                break
            aim = np.minimum(answer.reached[live] + step[live], 1.0)
            part = cases.rows(live)
            part = replace(part, loads=part.loads.scaled(aim))
            found = self._attempt(
                problem, part, u[:, live], ((self.thorough, min(MOST_STEP_OUTER, self.accuracy.outer)),)
            )
            good, spent = found.good, spent + found.linear_iterations
            answer.iterations[live] += found.iterations
            step[live] *= np.where(good, np.clip(STEP_OUTER / np.maximum(found.iterations, 1), 0.5, 2.0), CUT)
            u[:, live[good]] = found.u[:, good]
            answer.reached[live[good]] = aim[good]
            answer.residual[live[good]] = found.residual[good]
        answer.outcome[answer.reached == 1.0] = Outcome.CONVERGED_IN_STEPS
        stepped = answer.reached > 0.0
        answer.u[:, stepped] = u[:, stepped]
        short = np.flatnonzero(stepped & (answer.reached < 1.0))
        if len(short):
            problem.begin(cases.rows(short))
            answer.residual[short] = shortfall(problem, u[:, short])
        return replace(answer, inverted=self.inversion.count(answer.u))


def shortfall(problem: Problem, u: np.ndarray) -> np.ndarray:
    """The relative residual (b,) of u (3N, b) under the whole load, or the share of imposed motion that is missing."""
    array = problem.device.array(u)
    _, free, scale = problem.residual(array)
    gap, size = problem.constraint.close_gap(array)
    largest = np.abs(u + gap.numpy()).max(axis=0, initial=0.0)
    share = [np.divide(a, b, out=np.zeros(len(b)), where=b > 0.0) for a, b in ((free, scale), (size, largest))]
    return np.maximum(*share)

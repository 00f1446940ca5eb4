"""What a plan (`plan.py`) says is tried for a load, one solver after the other: from the start, from rest, in steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
import warp as wp

from ..accuracy import Accuracy
from ..deformation import Outcome
from ..discretisation.inverted_elements import Inversion
from ..discretisation.problem import Problem
from ..discretisation.term import Cases, Local
from ..linalg.pcg import Preconditioner
from ..local_solvers.batch_elimination import BatchElimination
from ..local_solvers.contact_descent import ContactDescent
from ..local_solvers.contact_preconditioner import build_contact_preconditioner
from ..local_solvers.strained_part import ON_CARD
from ..minimisers.lbfgs import Lbfgs, restore_history
from ..minimisers.lbfgs_kernels import BROKEN, DONE
from ..minimisers.newton import find_equilibrium
from ..minimisers.newton_cg import NewtonCG
from ..minimisers.residual import measure_residual
from ..runtime.columns import gather_columns, scatter_columns
from ..runtime.device import Device
from ..runtime.views import run_in_order, to_host, view
from .plan import Alone, SolverPlan, SolverStep
from .stepping import GAPS, STEPPING, GapContinuation, LoadStepping, Shares

NOTHING: Mapping[str, np.ndarray] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class SolverResult:
    """u (3N, B) [m] on the device; (B,): outcomes, outer steps, residuals, shares of the load reached, inverted tets.

    The linear iterations of the batch; what of the curvature the next frame may know. Where tools move, shares (B,) of
    their way at which they are, and (B,) bool whose way began at rest.
    """

    u: wp.array
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    reached: np.ndarray
    inverted: np.ndarray
    linear_iterations: int
    learnt: Mapping[str, np.ndarray] = field(default_factory=dict)
    gone: np.ndarray | None = None
    anew: np.ndarray | None = None

    @property
    def good(self) -> np.ndarray:
        """(B,) bool."""
        return np.array([outcome.good for outcome in self.outcome], bool)

    def put(self, index: np.ndarray, other: SolverResult, device: Device) -> None:
        """Write the answer of other cases over some of these (k,); outer steps add up."""
        scatter_columns(device, other.u, index, self.u)
        self.iterations[index] += other.iterations
        for name in ("outcome", "residual", "reached", "inverted"):
            getattr(self, name)[index] = getattr(other, name)


@dataclass(frozen=True, eq=False)
class Strategy:
    """The solvers of a plan: each takes what the one before it did not bring to equilibrium.

    problem
        What the cases are posed on.
    preconditioner
        Of the problem: L-BFGS starts from it, Newton's linear systems are solved with it.
    inversion
        Of the discretisation that the problem is posed on.
    accuracy
        Tolerance and budgets.
    plan
        Which solvers are tried, and in which order.
    near
        Makes, or has made, what `plan` solves by itself for many loads.
    alone
        What it solves by itself for one.
    stepping, gaps
        How load steps go, and the gaps of tools.
    """

    problem: Problem
    preconditioner: Preconditioner
    inversion: Inversion
    accuracy: Accuracy
    plan: SolverPlan
    near: Callable[[], BatchElimination | None] = lambda: None
    alone: Alone | None = None
    stepping: LoadStepping = STEPPING
    gaps: GapContinuation = GAPS

    @cached_property
    def lbfgs(self) -> Lbfgs:
        """L-BFGS on the whole body, with what it keeps from batch to batch."""
        return Lbfgs(self.problem, self.preconditioner)

    @cached_property
    def contact(self) -> ContactDescent | None:
        """What solves the nodes that tools touch apart from the tissue; None where the plan does not."""
        if self.plan.contact is not SolverStep.CONTACT:
            return None
        (barrier,) = self.problem.barriers
        assert isinstance(barrier, Local)
        found = ContactDescent(self.problem, self.preconditioner, barrier)
        return replace(found, strains=ON_CARD, replays=True) if self.problem.device.on_cuda else found

    def local(self, count: int) -> BatchElimination | Alone | None:
        """What solves a part by itself for so many loads, if anything does."""
        step = self.plan.local(count)
        return None if step is None else self.near() if step is SolverStep.NEAR else self.alone

    @cached_property
    def _touched(self) -> Preconditioner:
        """The preconditioner that knows contact: on CUDA half precision is rougher than contact is stiff."""
        if self.problem.device.on_cuda:
            return self.preconditioner
        return build_contact_preconditioner(self.problem, self.preconditioner, self.contact)

    @property
    def held(self) -> int:
        """Bytes that L-BFGS keeps for the next batch to stand in."""
        return self.lbfgs.held

    def solve(self, cases: Cases, guesses: Sequence[np.ndarray]) -> SolverResult:
        """Solve for the equilibria of B cases, each from its first usable guess (3N, B) [m], or from rest.

        A start that lies inside out is left alone, and so is a state that does to which a start led. A body turned over
        or collapsed may be in equilibrium with itself. From rest such a state is taken as the load's doing. Where
        nothing acts it stays at rest: the answer is exactly zero.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        problem.begin(cases)
        if not guesses:
            answer, astray = self._whole(cases), np.zeros(count, bool)
        else:
            acts = self._acts(count)
            guess, astray = self._upright([np.where(acts, one, 0.0) for one in guesses])
            started = guess.any(axis=0)
            learnt = NOTHING if astray.any() else restore_history(cases, problem.rows)
            if problem.barriers and astray.any():
                cases = replace(cases, anew=astray.copy())
                problem.begin(cases)
            answer = self._whole(cases, device.array(np.where(astray, 0.0, guess)), learnt)
            lost = np.where(answer.good, self.inversion.doubtful(answer.inverted), self._lost(answer))
            again = np.flatnonzero(started & ~astray & lost)
            if len(again):
                astray[again] = True
                some = replace(cases.rows(again), anew=np.ones(len(again), bool))
                problem.begin(some)
                answer.put(again, self._whole(some), device)
        answer.outcome[astray & answer.good] = Outcome.CONVERGED_ANEW
        lost = np.flatnonzero(self._lost(answer))
        if len(lost):
            found = self._in_steps(cases.rows(lost), answer, lost)
            astray[lost] |= found.reached > answer.reached[lost]
            answer.put(lost, found, device)
        return replace(answer, gone=answer.reached, anew=astray) if problem.barriers else answer

    def _acts(self, count: int) -> np.ndarray:
        """Which cases (b,) of the batch that has begun any force or imposed motion acts on at rest."""
        rest = self.problem.device.zeros(self.problem.rows, count)
        loud = wp.zeros_like(rest)
        for term in self.problem.terms:
            if not term.passive:
                term.add_gradient(rest, loud)
        with run_in_order(self.problem.device):
            acts = to_host((view(loud) != 0.0).any(0))
        if not acts.all():
            acts = np.logical_or.reduce([acts, *(term.buried(rest) for term in self.problem.barriers)])
        return acts | self.problem.gap(rest)[1] if self.problem.constraint.imposes else acts

    def _rested(self, start: wp.array) -> wp.array:
        """Start (3N, b) [m], or rest where nothing acts there: in float32 no descent would end in letting go."""
        acts = self._acts(start.shape[1])
        if not acts.all():
            with run_in_order(self.problem.device):
                view(start := wp.clone(start))[:, ~acts] = 0.0
        return start

    def _upright(self, guesses: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Of some guesses (3N, B) [m] each case's first of the fewest inside out; which cases (B,) have none."""
        device = self.problem.device
        guess, inverted = guesses[0], self.inversion.count(device.array(guesses[0]))
        for other in guesses[1:]:
            if inverted.any():
                fewer = self.inversion.count(device.array(other))
                guess, inverted = np.where(fewer < inverted, other, guess), np.minimum(fewer, inverted)
        return guess, self.inversion.doubtful(inverted)

    def _lost(self, answer: SolverResult) -> np.ndarray:
        """Which cases (B,) another solver may save: at round-off none is nearer to equilibrium."""
        return ~answer.good & (answer.outcome != Outcome.ROUND_OFF) & (self.accuracy.steps > 0)

    def _whole(
        self, cases: Cases, start: wp.array | None = None, learnt: Mapping[str, np.ndarray] | None = NOTHING
    ) -> SolverResult:
        """The whole load at once, of a batch that has begun: eliminations, L-BFGS, Newton, each from where one ended.

        From rest without a start; `learnt` on the way to it, if anything was. Motions that are imposed are left
        to Newton: it knows how the free nodes follow them. So are steep terms.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        # Rest satisfies whatever the batch does not move.
        imposed = problem.constraint.imposes or (start is not None and bool(problem.gap(start)[1].any()))
        start = device.zeros(problem.rows, count) if start is None else start
        if problem.barriers:
            return self._moved(cases, start)
        if problem.paced:  # the next frame would gain nothing
            learnt = None
        if SolverStep.LBFGS not in self.plan.steps(count, imposed):
            return self._thorough(start, self.accuracy.outer)
        near = self.local(count)
        descents = [(self.lbfgs, learnt)] if near is None else [(near, cases.warm), (self.lbfgs, None)]
        index, none, never = np.arange(count), np.zeros(count, int), np.full(count, np.inf)
        answer = SolverResult(
            wp.clone(start), np.full(count, Outcome.BUDGET, object), none, never, np.zeros(count), none.copy(), 0
        )
        gained: Mapping[str, np.ndarray] = {}
        left = self.plan.evaluations
        for descent, known in descents:
            found = descent.descend(start, np.full(len(index), self.accuracy.tolerance), left, known)
            left -= int(found.steps.max(initial=0))
            outcome = np.full(len(index), Outcome.BUDGET, object)
            outcome[found.status == DONE], outcome[found.status == BROKEN] = Outcome.CONVERGED, Outcome.NOT_FINITE
            answer.put(index, self._answer(found.u, outcome, found.steps, found.residual, 0), device)
            gained = found.learnt
            index = index[found.left]
            if len(index) == 0:
                break
            problem.begin(cases.rows(index))
            start = gather_columns(device, found.u, found.left)
        else:
            answer.put(index, self._thorough(start, self.accuracy.outer), device)
        return replace(answer, learnt=gained)

    def _touching(self, cases: Cases, start: wp.array, outer: int, gaps: float) -> SolverResult:
        """Of cases whose tools have gone so many times their gap: what touches and what gives apart, then Newton.

        On the CPU Newton has them one by one: the preconditioner of a single one knows what it touches.
        """
        problem, touch, device = self.problem, self.contact, self.problem.device
        problem.begin(cases)
        if touch is None or problem.constraint.imposes or problem.gap(start)[1].any():
            return self._closed(cases, start, outer, gaps)
        start, count, few = self._rested(start), len(cases.loads), min(self.gaps.alone, outer)
        found = touch.descend(start, np.full(count, self.accuracy.tolerance), few)
        outcome = np.full(count, Outcome.BUDGET, object)
        outcome[found.status == DONE] = Outcome.CONVERGED
        answer = self._answer(found.u, outcome, found.steps, found.residual, 0)

        def batched(rows: np.ndarray) -> Sequence[np.ndarray]:
            return [rows][: len(rows)] if device.on_cuda else list(rows[:, None])

        near = np.flatnonzero(~answer.good & (found.residual <= self.gaps.nearly))
        for some in batched(near):
            problem.begin(cases.rows(some))
            answer.put(some, self._thorough(gather_columns(device, found.u, some), few), device)
        left = np.flatnonzero(~answer.good)
        for some in batched(left):
            answer.put(some, self._closed(cases.rows(some), gather_columns(device, start, some), outer, gaps), device)
        return answer

    def _closed(self, cases: Cases, start: wp.array, outer: int, gaps: float) -> SolverResult:
        """Newton, of cases whose tools have gone so many times their gap: it is opened first, and closed step by step.

        In a narrow gap tissue would be thrown out of a tool, and caught again, node by node; a wide one leads it.
        """
        iterations, linear = np.zeros(start.shape[1], int), 0
        widest = int(np.ceil(np.log(max(gaps / self.gaps.wide_enough, 1.0)) / np.log(self.gaps.closing)))
        for times in self.gaps.closing ** np.arange(widest, 0.0, -1.0):
            self.problem.begin(cases)
            for term in self.problem.barriers:
                term.widen(float(times))
            found = self._thorough(self._rested(start), outer, max(self.gaps.tolerance, self.accuracy.tolerance))
            start, iterations, linear = found.u, iterations + found.iterations, linear + found.linear_iterations
        self.problem.begin(cases)
        found = self._thorough(self._rested(start), outer)
        linear += found.linear_iterations
        return replace(found, iterations=iterations + found.iterations, linear_iterations=linear)

    def _thorough(self, start: wp.array, outer: int, tolerance: float | None = None) -> SolverResult:
        """Newton, in at most so many outer steps, of a batch that has begun."""
        newton = NewtonCG(self._touched, self.accuracy.inner)
        accuracy = replace(self.accuracy, outer=outer, tolerance=tolerance or self.accuracy.tolerance)
        found = find_equilibrium(self.problem, newton, start, accuracy)
        return self._answer(found.u, found.outcome, found.iterations, found.residual, found.linear_iterations)

    def _answer(
        self, u: wp.array, outcome: np.ndarray, steps: np.ndarray, residual: np.ndarray, linear_iterations: int
    ) -> SolverResult:
        reached = np.array([ended.good for ended in outcome], float)
        return SolverResult(u, outcome, steps, residual, reached, self.inversion.count(u), linear_iterations)

    def _in_steps(self, cases: Cases, failed: SolverResult, index: np.ndarray) -> SolverResult:
        """From rest, the load raised in steps that grow and shrink; the equilibrium under the largest share found.

        Of cases that are the rows `index` (k,) of what failed; where no larger share is found that stands.
        """
        problem, device = self.problem, self.problem.device
        cases = replace(cases, anew=np.ones(len(index), bool))

        def raised(part: Cases, share: np.ndarray) -> Cases:
            return replace(part, loads=part.loads.scaled(share), share=share)

        start = device.zeros(problem.rows, len(index))
        found = self._by_steps(cases, start, raised, self.stepping.first, self.accuracy.steps)
        outcome = failed.outcome[index]
        outcome[found.reached == 1.0] = Outcome.CONVERGED_IN_STEPS
        none = np.flatnonzero(found.reached <= failed.reached[index])
        scatter_columns(device, failed.u, none, found.u, index[none])
        found.residual[none], found.reached[none] = failed.residual[index[none]], failed.reached[index[none]]
        return replace(found, outcome=outcome, inverted=self.inversion.count(found.u))

    def _moved(self, cases: Cases, start: wp.array) -> SolverResult:
        """From start (3N, b), where the tools were, as far as they may go at once again and again.

        A body at rest on which nothing acts where they end is there, whatever they met on their way.
        """

        def moved(part: Cases, share: np.ndarray) -> Cases:
            return replace(part, share=share)

        device, count, most = self.problem.device, len(cases.loads), self.accuracy.steps
        acting = np.flatnonzero(self._acts(count))
        if len(acting) == count:
            return self._by_steps(cases, start, moved, 1.0, most)
        none, every = np.zeros(count, int), np.full(count, Outcome.CONVERGED, object)
        answer = SolverResult(device.zeros(*start.shape), every, none, np.zeros(count), np.ones(count), none.copy(), 0)
        if len(acting):
            part = gather_columns(device, start, acting)
            answer.put(acting, self._by_steps(cases.rows(acting), part, moved, 1.0, most), device)
        return answer

    def _by_steps(
        self,
        cases: Cases,
        start: wp.array,
        aimed: Callable[[Cases, np.ndarray], Cases],
        first: float,
        most: int,
    ) -> SolverResult:
        """From start (3N, b), cases at growing shares: the equilibrium at the largest share found.

        `aimed` makes cases at shares (b,); the `first` step is so long, and none longer than tools may go at once.
        Those that are as long do not count among the `most`. Outcomes are good where the share is 1; on the way
        round-off will do.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        gaps = np.maximum.reduce([np.zeros(count), *(term.gaps(cases) for term in problem.barriers)])
        shares = Shares.at_rest(first, gaps)
        u, left, done = wp.clone(start), most, 1
        none, outcome = np.zeros(count, int), np.full(count, Outcome.BUDGET, object)
        answer = SolverResult(u, outcome, none, np.full(count, np.inf), shares.reached, none.copy(), 0)
        outer = self.accuracy.outer
        wanted, outer = (outer, outer) if problem.barriers else (self.stepping.aimed, min(self.stepping.most, outer))
        while left >= 0:
            strides = [term.stride(aimed(cases, shares.reached), u) for term in problem.barriers]
            shorter, going = shares.limit(np.minimum.reduce([np.ones(count), *strides]), self.stepping)
            rows = np.flatnonzero(going & (answer.iterations < self.accuracy.most))
            patience = self.stepping.patience * self.accuracy.inner * done
            if len(rows) == 0 or answer.linear_iterations > patience:
                break
            aim, gone = shares.propose_shares(rows)
            left -= int(shorter[rows].any())
            found = self._touching(aimed(cases.rows(rows), aim), gather_columns(device, u, rows), outer, gone)
            good = found.good | ((found.outcome == Outcome.ROUND_OFF) & (aim < 1.0))
            done += int(good.any())
            shares.take(rows, aim, good)
            growth = wanted / np.maximum(found.iterations, 1)
            shares.resize(rows, good, growth, self.stepping.cut, self.gaps.wider)
            scatter_columns(device, found.u, rows[good], u, np.flatnonzero(good))
            answer.iterations[rows] += found.iterations
            answer.residual[rows[good]], outcome[rows] = found.residual[good], found.outcome
            answer = replace(answer, linear_iterations=answer.linear_iterations + found.linear_iterations)
        return self._arrived(cases, aimed, answer)

    def _arrived(self, cases: Cases, aimed: Callable[[Cases, np.ndarray], Cases], answer: SolverResult) -> SolverResult:
        """Judge cases that went as far as they could, in place: those that tools pierce, and those that fell short."""
        problem, u, outcome, reached = self.problem, answer.u, answer.outcome, answer.reached
        short = np.flatnonzero(reached < 1.0)
        outcome[short] = [Outcome.BUDGET if ended.good else ended for ended in outcome[short]]
        if problem.barriers and len(short) < len(reached):
            problem.begin(aimed(cases, np.ones(len(reached))))
            buried = np.logical_or.reduce([term.buried(u) for term in problem.barriers])
            pierced = (problem.overlaps(u)[0] | buried) & (reached == 1.0)
            outcome[pierced], reached[pierced] = Outcome.PIERCED, 0.0
        if len(short):
            problem.begin(cases.rows(short))
            answer.residual[short] = measure_residual(problem, gather_columns(problem.device, u, short))
        return replace(answer, inverted=self.inversion.count(u))

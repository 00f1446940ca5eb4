"""Execution of a plan (`plan.py`): solvers in order, from the start, from the undeformed state, and in load steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
import warp as wp

from ..accuracy import Accuracy
from ..deformation import Outcome
from ..discretisation.inverted_elements import InversionCounter
from ..discretisation.problem import Problem
from ..discretisation.term import Cases, LocalBarrier
from ..linalg.multifrontal import SparseFactor
from ..linalg.pcg import Preconditioner
from ..local_solvers.batch_elimination import BatchElimination
from ..local_solvers.contact_descent import ContactDescent
from ..local_solvers.contact_preconditioner import build_contact_preconditioner
from ..local_solvers.strained_part import STRAIN_LIMITS
from ..local_solvers.tangent_contact import TangentContact
from ..minimisers.lbfgs import Lbfgs, restore_history
from ..minimisers.lbfgs_kernels import DONE, NOT_FINITE
from ..minimisers.newton import find_equilibrium
from ..minimisers.newton_cg import NewtonCG
from ..minimisers.residual import measure_residual
from ..runtime.columns import gather_columns, scatter_columns
from ..runtime.views import run_in_order, to_host, to_view
from .plan import Alone, SolverPlan, SolverStep
from .solver_result import SolverResult
from .stepping import GAP_CONTINUATION, LOAD_STEPPING, GapContinuation, LoadProgress, LoadStepping

EMPTY_HISTORY: Mapping[str, np.ndarray] = MappingProxyType({})  # Empty L-BFGS history.


@dataclass(frozen=True, eq=False)
class Strategy:
    """Solvers of a plan in order; each solver continues with the cases that previous solvers did not solve.

    problem
        Problem of the cases.
    preconditioner
        Initial inverse Hessian of L-BFGS, and preconditioner of Newton's linear systems.
    inversion
        Counter of inverted elements for the discretisation of the problem.
    accuracy
        Tolerance and iteration limits.
    plan
        Solvers to try, in order.
    build_batch_solver
        Function that returns the local solver for many loads; the solver is built at the first call.
    single_solver
        Local solver for one load, or None.
    stepping, gaps
        Control of load steps, and of the contact gap.
    """

    problem: Problem
    preconditioner: Preconditioner
    inversion: InversionCounter
    accuracy: Accuracy
    plan: SolverPlan
    build_batch_solver: Callable[[], BatchElimination | None] = lambda: None
    single_solver: Alone | None = None
    stepping: LoadStepping = LOAD_STEPPING
    gaps: GapContinuation = GAP_CONTINUATION

    @cached_property
    def lbfgs(self) -> Lbfgs:
        """L-BFGS solver for the whole mesh; its memory is kept between batches."""
        return Lbfgs(self.problem, self.preconditioner)

    @cached_property
    def contact(self) -> ContactDescent | None:
        """Solver that treats nodes in contact separately from the tissue; None if the plan does not include it."""
        if self.plan.contact_solver is not SolverStep.CONTACT:
            return None
        (barrier,) = self.problem.barriers
        assert isinstance(barrier, LocalBarrier)
        found = ContactDescent(self.problem, self.preconditioner, barrier)
        return replace(found, strains=STRAIN_LIMITS, uses_graphs=True) if self.problem.device.on_cuda else found

    @cached_property
    def tangent_contact(self) -> TangentContact | None:
        """Contact solver for single load cases on the CPU; None on a GPU, or without a factor of the stiffness."""
        if self.contact is None or not isinstance(self.preconditioner, SparseFactor):
            return None
        return TangentContact(self.contact)

    def get_local_solver(self, count: int) -> BatchElimination | Alone | None:
        """Return the local solver for `count` loads, or None."""
        step = self.plan.choose_local_solver(count)
        return None if step is None else self.build_batch_solver() if step is SolverStep.NEAR else self.single_solver

    @cached_property
    def _contact_preconditioner(self) -> Preconditioner:
        """Preconditioner that includes contact; not on CUDA, where half precision does not resolve contact."""
        if self.problem.device.on_cuda:
            return self.preconditioner
        return build_contact_preconditioner(self.problem, self.preconditioner, self.contact)

    @property
    def kept_bytes(self) -> int:
        """Memory that L-BFGS keeps for the next batch [bytes]."""
        return self.lbfgs.kept_bytes

    def solve(self, cases: Cases, guesses: Sequence[np.ndarray]) -> SolverResult:
        """Return the equilibria of B cases, each from its first usable guess (3N, B) [m] or from the undeformed state.

        A start with too many inverted elements is not used. A solution with inverted elements is discarded if it came
        from a guess, since an inverted or collapsed mesh may also be in equilibrium. A solution from the undeformed
        state is accepted, as the load inverts the elements. The solution of cases without a load is exactly zero.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        problem.begin(cases)
        if not guesses:
            result, astray = self._solve_whole_load(cases), np.zeros(count, bool)
        else:
            acts = self._find_loaded_cases(count)
            guess, astray = self._select_guesses([np.where(acts, one, 0.0) for one in guesses])
            started = guess.any(axis=0)
            history = EMPTY_HISTORY if astray.any() else restore_history(cases, problem.rows)
            if problem.barriers and astray.any():
                cases = replace(cases, restarted=astray.copy())
                problem.begin(cases)
            result = self._solve_whole_load(cases, device.upload(np.where(astray, 0.0, guess)), history)
            lost = np.where(result.good, self.inversion.find_unreliable(result.inverted), self._find_unsolved(result))
            again = np.flatnonzero(started & ~astray & lost)
            if len(again):
                astray[again] = True
                some = replace(cases.select(again), restarted=np.ones(len(again), bool))
                problem.begin(some)
                result.replace_cases(again, self._solve_whole_load(some), device)
        result.outcome[astray & result.good] = Outcome.CONVERGED_ANEW
        lost = np.flatnonzero(self._find_unsolved(result))
        if len(lost):
            found = self._raise_load(cases.select(lost), result, lost)
            astray[lost] |= found.reached > result.reached[lost]
            result.replace_cases(lost, found, device)
        return replace(result, path_fraction=result.reached, restarted=astray) if problem.barriers else result

    def _find_loaded_cases(self, count: int) -> np.ndarray:
        """Return a mask (b,) of cases in the current batch with a force or imposed motion in the undeformed state."""
        rest = self.problem.device.allocate(self.problem.rows, count)
        loud = wp.zeros_like(rest)
        for term in self.problem.terms:
            if not term.passive:
                term.add_gradient(rest, loud)
        with run_in_order(self.problem.device):
            acts = to_host((to_view(loud) != 0.0).any(0))
        if not acts.all():
            acts = np.logical_or.reduce([acts, *(term.find_penetrating(rest) for term in self.problem.barriers)])
        return acts | self.problem.compute_gap(rest)[1] if self.problem.constraint.has_motion else acts

    def _mask_idle(self, start: wp.array) -> wp.array:
        """Return the start (3N, b) [m] with zeros in cases without a load, which a float32 descent would not reach."""
        acts = self._find_loaded_cases(start.shape[1])
        if not acts.all():
            with run_in_order(self.problem.device):
                to_view(start := wp.clone(start))[:, ~acts] = 0.0
        return start

    def _select_guesses(self, guesses: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the guess (3N, B) [m] with the fewest inverted elements, and a mask (B,) of cases without a guess."""
        device = self.problem.device
        guess, inverted = guesses[0], self.inversion.count(device.upload(guesses[0]))
        for other in guesses[1:]:
            if inverted.any():
                fewer = self.inversion.count(device.upload(other))
                guess, inverted = np.where(fewer < inverted, other, guess), np.minimum(fewer, inverted)
        return guess, self.inversion.find_unreliable(inverted)

    def _find_unsolved(self, result: SolverResult) -> np.ndarray:
        """Return a mask (B,) of cases that another solver may solve; at round-off, no solver improves the result."""
        return ~result.good & (result.outcome != Outcome.ROUND_OFF) & (self.accuracy.steps > 0)

    def _solve_whole_load(
        self, cases: Cases, start: wp.array | None = None, history: Mapping[str, np.ndarray] | None = EMPTY_HISTORY
    ) -> SolverResult:
        """Return the result for the whole load of the current batch, by local solvers, L-BFGS and Newton in sequence.

        Without a start, the initial state is undeformed. `history` is the L-BFGS history of the start, if any. Imposed
        motions and steep terms are solved by Newton's method, which moves the free nodes accordingly.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        # The undeformed state satisfies the constraints, unless the batch imposes motion.
        imposed = problem.constraint.has_motion or (start is not None and bool(problem.compute_gap(start)[1].any()))
        start = device.allocate(problem.rows, count) if start is None else start
        if problem.barriers:
            return self._move_tools(cases, start)
        if problem.depends_on_step:  # history would not help the next frame
            history = None
        if SolverStep.LBFGS not in self.plan.list_steps(count, imposed):
            return self._run_newton(start, self.accuracy.outer)
        near = self.get_local_solver(count)
        descents = [(self.lbfgs, history)] if near is None else [(near, cases.warm), (self.lbfgs, None)]
        index, none, never = np.arange(count), np.zeros(count, int), np.full(count, np.inf)
        result = SolverResult(
            wp.clone(start), np.full(count, Outcome.BUDGET, object), none, never, np.zeros(count), none.copy(), 0
        )
        gained: Mapping[str, np.ndarray] = {}
        left = self.plan.max_evaluations
        for descent, known in descents:
            found = descent.descend(start, np.full(len(index), self.accuracy.tolerance), left, known)
            left -= int(found.steps.max(initial=0))
            outcome = np.full(len(index), Outcome.BUDGET, object)
            outcome[found.status == DONE], outcome[found.status == NOT_FINITE] = Outcome.CONVERGED, Outcome.NOT_FINITE
            result.replace_cases(index, self._build_result(found.u, outcome, found.steps, found.residual, 0), device)
            gained = found.warm_start
            index = index[found.unfinished_cases]
            if len(index) == 0:
                break
            problem.begin(cases.select(index))
            start = gather_columns(device, found.u, found.unfinished_cases)
        else:
            result.replace_cases(index, self._run_newton(start, self.accuracy.outer), device)
        return replace(result, warm_start=gained)

    def _solve_contact(self, cases: Cases, start: wp.array, outer: int, gaps: float) -> SolverResult:
        """Return the result for cases whose tools have moved by `gaps` gaps, by the contact solver and Newton's method.

        On the CPU, Newton's method solves the cases one by one, since the contact preconditioner is for a single case.
        """
        problem, touch, device = self.problem, self.contact, self.problem.device
        problem.begin(cases)
        if touch is None or problem.constraint.has_motion or problem.compute_gap(start)[1].any():
            return self._close_gaps(cases, start, outer, gaps)
        start, count, few = self._mask_idle(start), len(cases.loads), min(self.gaps.max_contact_iterations, outer)
        tolerance = np.full(count, self.accuracy.tolerance)
        if count == 1 and self.tangent_contact is not None:
            found = self.tangent_contact.descend(start, tolerance, few, cases.warm)
        else:
            found = touch.descend(start, tolerance, few)
        outcome = np.full(count, Outcome.BUDGET, object)
        outcome[found.status == DONE] = Outcome.CONVERGED
        result = self._build_result(found.u, outcome, found.steps, found.residual, 0)
        result = replace(result, warm_start=found.warm_start)

        def split_rows(rows: np.ndarray) -> Sequence[np.ndarray]:
            return [rows][: len(rows)] if device.on_cuda else list(rows[:, None])

        near = np.flatnonzero(~result.good & (found.residual <= self.gaps.newton_residual))
        for some in split_rows(near):
            problem.begin(cases.select(some))
            result.replace_cases(some, self._run_newton(gather_columns(device, found.u, some), few), device)
        left = np.flatnonzero(~result.good)
        for some in split_rows(left):
            begun = gather_columns(device, start, some)
            result.replace_cases(some, self._close_gaps(cases.select(some), begun, outer, gaps), device)
        return result

    def _close_gaps(self, cases: Cases, start: wp.array, outer: int, gaps: float) -> SolverResult:
        """Return the result for cases whose tools have moved by `gaps` gaps, by Newton's method with a widened gap.

        The gap is then closed in steps. In a narrow gap, nodes would leave and enter the tool one by one.
        """
        iterations, linear = np.zeros(start.shape[1], int), 0
        widest = int(np.ceil(np.log(max(gaps / self.gaps.max_gaps, 1.0)) / np.log(self.gaps.closing_factor)))
        for times in self.gaps.closing_factor ** np.arange(widest, 0.0, -1.0):
            self.problem.begin(cases)
            for term in self.problem.barriers:
                term.widen_gap(float(times))
            found = self._run_newton(self._mask_idle(start), outer, max(self.gaps.tolerance, self.accuracy.tolerance))
            start, iterations, linear = found.u, iterations + found.iterations, linear + found.linear_iterations
        self.problem.begin(cases)
        found = self._run_newton(self._mask_idle(start), outer)
        linear += found.linear_iterations
        return replace(found, iterations=iterations + found.iterations, linear_iterations=linear)

    def _run_newton(self, start: wp.array, outer: int, tolerance: float | None = None) -> SolverResult:
        """Return the result for the current batch by Newton's method, in at most `outer` iterations."""
        accuracy = replace(self.accuracy, outer=outer, tolerance=tolerance or self.accuracy.tolerance)
        found = find_equilibrium(self.problem, NewtonCG(self._contact_preconditioner, accuracy.inner), start, accuracy)
        return self._build_result(found.u, found.outcome, found.iterations, found.residual, found.linear_iterations)

    def _build_result(
        self, u: wp.array, outcome: np.ndarray, steps: np.ndarray, residual: np.ndarray, linear_iterations: int
    ) -> SolverResult:
        reached = np.array([ended.good for ended in outcome], float)
        return SolverResult(u, outcome, steps, residual, reached, self.inversion.count(u), linear_iterations)

    def _raise_load(self, cases: Cases, result: SolverResult, index: np.ndarray) -> SolverResult:
        """Return the equilibrium at the largest load fraction found by adaptive load steps from the undeformed state.

        The cases are the rows `index` (k,) of `result`, which is kept if no larger fraction is found.
        """
        problem, device = self.problem, self.problem.device
        cases = replace(cases, restarted=np.ones(len(index), bool))

        def scale_loads(cases: Cases, fraction: np.ndarray) -> Cases:
            return replace(cases, loads=cases.loads.scale(fraction), share=fraction)

        start = device.allocate(problem.rows, len(index))
        found = self._solve_in_steps(cases, start, scale_loads, self.stepping.first_step, self.accuracy.steps)
        outcome = result.outcome[index]
        outcome[found.reached == 1.0] = Outcome.CONVERGED_IN_STEPS
        none = np.flatnonzero(found.reached <= result.reached[index])
        scatter_columns(device, result.u, none, found.u, index[none])
        found.residual[none], found.reached[none] = result.residual[index[none]], result.reached[index[none]]
        return replace(found, outcome=outcome, inverted=self.inversion.count(found.u))

    def _move_tools(self, cases: Cases, start: wp.array) -> SolverResult:
        """Return the result after moving the tools from the state `start` (3N, b), in steps of the allowed length.

        If no force acts on the undeformed mesh at the end of the path, the undeformed mesh is the solution.
        """

        def move(cases: Cases, fraction: np.ndarray) -> Cases:
            return replace(cases, share=fraction)

        device, count, most = self.problem.device, len(cases.loads), self.accuracy.steps
        acting = np.flatnonzero(self._find_loaded_cases(count))
        if len(acting) == count:
            return self._solve_in_steps(cases, start, move, 1.0, most)
        none, every = np.zeros(count, int), np.full(count, Outcome.CONVERGED, object)
        result = SolverResult(
            device.allocate(*start.shape), every, none, np.zeros(count), np.ones(count), none.copy(), 0
        )
        if len(acting):
            part = gather_columns(device, start, acting)
            result.replace_cases(acting, self._solve_in_steps(cases.select(acting), part, move, 1.0, most), device)
        return result

    def _solve_in_steps(
        self, cases: Cases, start: wp.array, scale: Callable[[Cases, np.ndarray], Cases], first_step: float, limit: int
    ) -> SolverResult:
        """Solve for cases at growing fractions from `start` (3N, b); return the equilibrium at the largest fraction.

        `scale` returns the cases at fractions (b,). The first step has the length `first_step`. Steps are limited by
        the motion that tools may make at once, and at most `limit` steps may be shorter than this limit. A good outcome
        requires the fraction 1; at smaller fractions, a residual at round-off is also accepted.
        """
        problem, device, count = self.problem, self.problem.device, len(cases.loads)
        gaps = np.maximum.reduce([np.zeros(count), *(term.compute_path_in_gaps(cases) for term in problem.barriers)])
        shares = LoadProgress.start(first_step, gaps)
        u, left, done = wp.clone(start), limit, 1
        none, outcome = np.zeros(count, int), np.full(count, Outcome.BUDGET, object)
        result = SolverResult(u, outcome, none, np.full(count, np.inf), shares.reached_fraction, none.copy(), 0)
        outer = self.accuracy.outer
        wanted = outer if problem.barriers else self.stepping.target_iterations
        outer = outer if problem.barriers else min(self.stepping.max_iterations, outer)
        while left >= 0:
            strides = [term.compute_stride(scale(cases, shares.reached_fraction), u) for term in problem.barriers]
            shorter, going = shares.limit_steps(np.minimum.reduce([np.ones(count), *strides]), self.stepping)
            rows = np.flatnonzero(going & (result.iterations < self.accuracy.most))
            patience = self.stepping.patience * self.accuracy.inner * done
            if len(rows) == 0 or result.linear_iterations > patience:
                break
            aim, travel = shares.propose_fractions(rows)
            left -= int(shorter[rows].any())
            part = scale(cases.select(rows), aim)
            found = self._solve_contact(part, gather_columns(device, u, rows), outer, travel)
            good = found.good | ((found.outcome == Outcome.ROUND_OFF) & (aim < 1.0))
            done += int(good.any())
            shares.take_steps(rows, aim, good)
            growth = wanted / np.maximum(found.iterations, 1)
            shares.resize_steps(rows, good, growth, self.stepping.failure_factor, self.gaps.failure_factor)
            scatter_columns(device, found.u, rows[good], u, np.flatnonzero(good))
            result.iterations[rows] += found.iterations
            result.residual[rows[good]], outcome[rows] = found.residual[good], found.outcome
            result = replace(result, linear_iterations=result.linear_iterations + found.linear_iterations)
            if count == 1:
                cases = replace(cases, warm={**cases.warm, **found.warm_start})
                result = replace(result, warm_start=found.warm_start)
        return self._mark_failed_cases(cases, scale, result)

    def _mark_failed_cases(
        self, cases: Cases, scale: Callable[[Cases, np.ndarray], Cases], result: SolverResult
    ) -> SolverResult:
        """Return the result after the last step, with marks for cases pierced by a tool or below the whole load."""
        problem, u, outcome, reached = self.problem, result.u, result.outcome, result.reached
        short = np.flatnonzero(reached < 1.0)
        outcome[short] = [Outcome.BUDGET if ended.good else ended for ended in outcome[short]]
        if problem.barriers and len(short) < len(reached):
            problem.begin(scale(cases, np.ones(len(reached))))
            buried = np.logical_or.reduce([term.find_penetrating(u) for term in problem.barriers])
            pierced = (problem.find_overlaps(u)[0] | buried) & (reached == 1.0)
            outcome[pierced], reached[pierced] = Outcome.PIERCED, 0.0
        if len(short):
            problem.begin(cases.select(short))
            result.residual[short] = measure_residual(problem, gather_columns(problem.device, u, short))
        return replace(result, inverted=self.inversion.count(u))

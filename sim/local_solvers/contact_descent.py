"""Equilibrium of tissue with rigid tools that touch few nodes: quadratic model of the tissue, exact contact energy.

A proximal quasi-Newton method (Lee, Sun, Saunders 2014, "Proximal Newton-type methods for minimizing composite
functions", SIAM J. Optim. 24:1420-1443). Each step minimises

    s'(u) x + x . B x / 2 + c(u + x),

where s is the energy of the smooth terms, B the undeformed stiffness with its L-BFGS or strain update, and c the
barrier energy of the tools, without approximation. c depends only on the few touchable nodes. With H = B^-1, all nodes
move by x = -H (s'(u) + f), where f are the tool forces from `contact_forces`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.term import LocalBarrier
from ..linalg.compliance import Compliance
from ..linalg.pcg import Preconditioner
from ..linalg.preconditioner import is_exact
from ..minimisers.compact_lbfgs import BatchHistory
from ..minimisers.lbfgs import DescentResult
from ..minimisers.lbfgs_kernels import DONE, LIVE, NOT_FINITE
from ..minimisers.line_search import backtrack_by_slopes, is_step_too_long
from ..minimisers.residual import ResidualEvaluator, build_evaluator
from ..runtime.device import Device
from ..runtime.views import cast_like, from_view, run_in_order, select_columns, to_double, to_host, to_library, to_view
from .contact_batch import Batch, ContactState
from .contact_forces import FORCES, NONCONVEX, ContactCompliance, ForceLimits, allocate_scratch, solve_contact_forces
from .contact_limits import CONTACT_LIMITS, ContactLimits
from .contact_steps import PREDICTED_DECREASE, STATUS, ContactSteps, read_step_result
from .contact_structs import SOLVED, TOO_MANY_TOUCHED, Scratch
from .strained_part import StrainedPart, StrainLimits


@dataclass(frozen=True, eq=False)
class ContactDescent:
    """Solver for a problem with one `LocalBarrier`; the start must satisfy the constraints.

    problem
        Problem to solve.
    preconditioner
        Inverse of the undeformed stiffness of the problem; it does not depend on the state.
    barrier
        Only barrier of the problem.
    limits
        Limits of the iterations.
    strains
        Limits of the models of strained tissue; None: no models, but L-BFGS pairs.
    uses_graphs
        True if steps of single load cases are captured as CUDA graphs.
    """

    problem: Problem
    preconditioner: Preconditioner
    barrier: LocalBarrier
    limits: ContactLimits = CONTACT_LIMITS
    strains: StrainLimits | None = None
    uses_graphs: bool = False

    @cached_property
    def compliance(self) -> Compliance:
        """Compliance at the touchable nodes, followed by other nodes that a model of strained tissue may include."""
        exact, own, strains = is_exact(self.preconditioner), self.barrier.touchable_nodes, self.strains
        nodes = self.barrier.select_nodes(strains.max_candidates) if exact and strains is not None else own
        compliance = Compliance(self.problem, self.preconditioner, nodes)
        if exact and self.problem.device.on_cuda:  # all columns take as long as one
            compliance.ensure_columns(np.arange(len(nodes)) < len(own))
        return compliance

    @cached_property
    def _strained_part(self) -> StrainedPart | None:
        """Builder of models of strained tissue; None with multigrid, where the compliance takes too long."""
        if not is_exact(self.preconditioner) or self.strains is None:
            return None
        return StrainedPart(self.problem, self.compliance, len(self.barrier.touchable_nodes), self.strains)

    @cached_property
    def captured_steps(self) -> ContactSteps | None:
        """Captured steps for single load cases, or None if steps are not captured."""
        if self._strained_part is None or not self.uses_graphs:
            return None
        self._strained_part.prepare()
        size = self._strained_part.size
        return ContactSteps(self.problem, self.preconditioner, self.barrier, self.compliance, size)

    @cached_property
    def _touchable_rows(self) -> Any:
        """Rows (3n,) of the touchable nodes, on the device."""
        return self.compliance.places[: 3 * len(self.barrier.touchable_nodes)]

    @cached_property
    def _scratch(self) -> Callable[[int, int, int], Scratch]:
        """Function `allocate_scratch` with a cache of the last two results, since allocation is slow."""
        return lru_cache(2)(partial(allocate_scratch, self._device))

    @property
    def _device(self) -> Device:
        """Device of the problem, with double precision."""
        return replace(self.problem.device, precision="float64")

    def descend(self, start: wp.array, tolerance: np.ndarray, max_iter: int) -> DescentResult:
        """Return the result as `Lbfgs.descend`, after at most `max_iter` steps per load case, without a history."""
        count, device, limits = start.shape[1], self.problem.device, self.limits
        result, live = wp.clone(start), np.arange(count)
        status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
        with run_in_order(device):
            batch = self._begin_batch(start)
            if count == 1 and self.captured_steps is not None:
                self._run_captured(self.captured_steps, batch, tolerance, max_iter)
            ready = np.ones(count, bool)
            while True:
                over = ready & self._find_ended_cases(batch, tolerance[live], max_iter)
                done = over & (batch.state.relative <= tolerance[live])
                if (ready & ~over).any():
                    over |= self._compute_directions(batch, ready & ~over, tolerance[live])
                if over.any():
                    leave = np.flatnonzero(over)
                    there = live[leave]
                    to_view(result)[:, there] = batch.state.u[:, leave]
                    status[there] = np.where(done, DONE, np.where(batch.state.is_finite, LIVE, NOT_FINITE))[leave]
                    steps[there], residual[there] = batch.steps[leave], batch.state.relative[leave]
                    batch.has_ended |= over
                    if batch.has_ended.all():
                        return DescentResult(result, status, steps, residual, {})
                    if batch.has_ended.mean() >= limits.max_ended_fraction:
                        stay = np.flatnonzero(~batch.has_ended)
                        batch.keep(stay)
                        live = live[stay]
                ready = self._try_steps(batch)

    def _begin_batch(self, start: wp.array) -> Batch:
        judge, count = build_evaluator(self.problem, start), start.shape[1]
        now = self._evaluate_state(judge, to_view(start) + 0.0)
        force, none = self._compute_balancing_forces(now), np.zeros(count)
        rest = self._compute_response(now.smooth_gradient, force)
        model = None
        if self._strained_part is not None and self.strains is not None and count <= self.strains.max_cases:
            model = self._strained_part.build_model(start, np.arange(count))
        pairs = BatchHistory(self.problem.device, self.problem.rows, count if model is None else 0)
        slow, steps, failed = np.zeros((3, count), int)
        stale, wait, end = np.zeros((3, count), bool)
        return Batch(
            evaluator=judge, state=now, history=pairs, model=model, is_stale=stale, force=force, response=rest,
            target_force=force + 0.0, d=0.0 * rest, step_length=none, predicted_decrease=none.copy(),
            proximal=none.copy(), stall_counts=slow, steps=steps, failure_counts=failed, is_waiting=wait, has_ended=end,
        )  # fmt: skip

    def _run_captured(self, steps: ContactSteps, batch: Batch, tolerance: np.ndarray, max_iter: int) -> None:
        """Run captured steps of a single load case until it ends.

        Return early if the load case needs a larger workspace or Newton's method, which captured steps do not include.
        """
        known, judge, limits = None, batch.evaluator, self.limits
        if batch.model is None or not steps.load_tools(judge.constant):
            return
        batch.state, batch.force, batch.response, batch.d = steps.load_state(batch.state, batch.force, batch.response)
        while not self._find_ended_cases(batch, tolerance, max_iter).any():
            self._rebuild_models(batch, np.ones(1, bool))
            if batch.model is not known:
                known = batch.model
                steps.load_model(known)
            force_tolerance = self._compute_force_tolerance(batch, tolerance)[0]
            said = steps.compute_direction(force_tolerance, batch.proximal[0], bool(self._find_nonconvex(batch)[0]))
            if said[STATUS] == TOO_MANY_TOUCHED:
                return
            if self._increase_proximal_term(batch, said[[STATUS]] != SOLVED).any():
                return
            if batch.is_waiting.any():
                # The load case's model may have been reset.
                known = None if batch.failure_counts[0] % limits.max_failures == 0 else known
                continue
            batch.predicted_decrease[:] = said[PREDICTED_DECREASE]
            while True:
                t, ahead, free, scale = read_step_result(said, judge.norms)
                there, misled = self._take_steps(batch, t, ahead, free)
                if there.any() or misled.any():
                    break
                said = steps.shorten_step(batch.step_length[0])
            if there.any():
                steps.take_step()
                batch.state.norm[:], batch.state.scale[:] = free, scale
            else:  # the load case's model has been reset
                known = None

    def _find_ended_cases(self, batch: Batch, tolerance: np.ndarray, max_iter: int) -> np.ndarray:
        """Return a mask (b,) of load cases that have ended, in equilibrium or not."""
        lost = (batch.stall_counts >= self.limits.patience) | (batch.steps >= max_iter) | ~batch.state.is_finite
        return lost | (batch.state.relative <= tolerance)

    def _rebuild_models(self, batch: Batch, mask: np.ndarray) -> None:
        """Recompute the stale models of the load cases in the mask `mask` (b,)."""
        renewed = np.flatnonzero(mask & batch.is_stale)
        if batch.model is not None and self._strained_part is not None and len(renewed):
            fresh = self._strained_part.build_model(from_view(self.problem.device, batch.state.u), renewed)
            batch.is_stale &= ~mask
            batch.model = batch.model.merge_columns(renewed, fresh)

    def _compute_force_tolerance(self, batch: Batch, tolerance: np.ndarray) -> np.ndarray:
        """Return the relative tolerance (b,) of the tool forces."""
        limits = self.limits
        return np.maximum(limits.forcing * np.minimum(batch.state.relative, 1.0), limits.tolerance_factor * tolerance)

    def _compute_directions(self, batch: Batch, mask: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
        """Compute directions of the load cases in the mask `mask` (b,); return a mask (b,) of final failures.

        A load case whose model has no equilibrium waits for the next call, with a larger proximal term. If this fails,
        its model is reset; finally a nonconvex model is accepted. The other load cases continue without waiting.
        """
        self._rebuild_models(batch, mask)
        force, found = batch.force + 0.0, np.zeros(len(mask), bool)
        bent = self._find_nonconvex(batch)
        for some, limits in ((np.flatnonzero(mask & ~bent), FORCES), (np.flatnonzero(mask & bent), NONCONVEX)):
            if len(some):
                on = select_columns(self.problem.device, some, len(mask))
                force[:, on], found[some] = self._solve_forces(batch, some, tolerance, limits)
        over = self._increase_proximal_term(batch, mask & ~found)
        some = np.flatnonzero(found)
        if len(some):
            self._compute_steps(batch, some, force)
        return over

    def _find_nonconvex(self, batch: Batch) -> np.ndarray:
        """Return a mask (b,) of load cases for which a nonconvex model is accepted."""
        return batch.failure_counts >= 2 * self.limits.max_failures

    def _increase_proximal_term(self, batch: Batch, case_mask: np.ndarray) -> np.ndarray:
        """Increase the proximal coefficient of cases in `case_mask` (b,); return a mask (b,) of cases to give up."""
        times = self.limits.max_failures
        batch.is_waiting = case_mask
        batch.failure_counts = np.where(case_mask, batch.failure_counts + 1, 0)
        fresh = case_mask & (batch.failure_counts % times == 0)
        batch.reset_model(np.flatnonzero(fresh))
        batch.proximal = np.where(fresh, 0.0, np.where(case_mask, self._raise_proximal(batch.proximal), batch.proximal))
        return batch.failure_counts >= 3 * times

    def _compute_steps(self, batch: Batch, cases: np.ndarray, force: Any) -> None:
        """Compute directions, step lengths and predicted decreases of cases `cases` (k,) under tool forces (3n, b)."""
        now, device = batch.state, self.problem.device
        on = select_columns(device, cases, len(batch.proximal))
        if batch.model is None:
            batch.response[:, on] += self.compliance.compute_full_motion((force - batch.force)[:, on])
            batch.force[:, on] = force[:, on]
            batch.d[:, on] = -batch.response[:, on]
        else:
            batch.target_force[:, on] = force[:, on]
            batch.d[:, on] = (
                -batch.response[:, on] - self.compliance.apply(self._compute_forces(batch, force)[0])[:, on]
            )
        if batch.history.max_pairs:
            history = batch.history.get_history(cases)
            batch.d[:, on] -= history.compute_motion(
                history.compute_weights(self._add_forces(now.smooth_gradient, force)[:, on])
            )
        longest = self.problem.longest_step(from_view(device, now.u), from_view(device, batch.d))
        batch.step_length[cases] = longest[cases]
        batch.predicted_decrease[cases] = -_compute_dots(now.gradient[:, on], batch.d[:, on])

    def _solve_forces(
        self, batch: Batch, cases: np.ndarray, tolerance: np.ndarray, limits: ForceLimits
    ) -> tuple[Any, np.ndarray]:
        """Return the tool forces (3n, k) on the models of load cases `cases` (k,), and a mask (k,) of solved cases."""
        rows, now = self._touchable_rows, batch.state
        on = select_columns(self.problem.device, cases, len(batch.proximal))
        barrier, known = self.barrier.reduce(cases), batch.force[:, on]
        if barrier is None:
            return known, np.ones(len(cases), bool)
        exact = self._compute_force_tolerance(batch, tolerance)[cases]
        soft, free = ContactCompliance(self.compliance, self._device, self._scratch), now.u[rows] - batch.response[rows]
        if batch.model is not None:
            free = free - self._compute_forces(batch, batch.force)[1]
            soft = replace(soft, strain_change=batch.model.change[on])
        free, here = free[:, on], to_double(now.u[rows][:, on])
        if batch.history.max_pairs:
            history = batch.history.get_history(cases)
            own = to_double(history.sw[:, :, rows])
            soft = replace(soft, history=own, middle_matrix=to_double(history.middle_matrix))
            weights = history.compute_weights(self._add_forces(now.smooth_gradient, batch.force)[:, on])
            free = free - (to_double(weights).mT @ own)[:, 0].T
        return solve_contact_forces(barrier, soft, here, to_double(free), known, exact, batch.proximal[cases], limits)

    def _compute_forces(self, batch: Batch, force: Any) -> tuple[Any, Any]:
        """Return additional forces (3N, b) [N] on the undeformed mesh: changes of tool forces, and model corrections.

        Also return the motion (3n, b) [m] of the touchable nodes under the model corrections.
        """
        assert batch.model is not None
        device, compliance = self.problem.device, self.compliance
        out, change = to_view(device.allocate(*batch.response.shape)), force - batch.force
        near = batch.response[compliance.places] + cast_like(batch.response, compliance.compute_motion(change))
        own = to_view(batch.model.apply_stiffness(device, from_view(device, near)))
        out[self._touchable_rows] = cast_like(out, change)
        out[compliance.places] += own
        return out, cast_like(batch.response, compliance.compute_motion(own)[: len(self._touchable_rows)])

    def _raise_proximal(self, proximal: np.ndarray) -> np.ndarray:
        return np.maximum(self.limits.proximal, self.limits.proximal_growth * proximal)

    def _try_steps(self, batch: Batch) -> np.ndarray:
        """Evaluate the trial step of each case that does not wait; return a mask (b,) of cases that need a direction.

        A direction is needed if the step is accepted, because the energy still decreases there, or nearly so; or if
        backtracking leaves almost no step: then the state is unchanged, and the model is reset.
        """
        now, going = batch.state, ~(batch.is_waiting | batch.has_ended)
        t = np.where(going, batch.step_length, 0.0)
        if not going.any():
            return batch.is_waiting & ~batch.has_ended
        new = self._evaluate_state(
            batch.evaluator, now.u + to_library(self.problem.device, t.astype(self.problem.device.precision)) * batch.d
        )
        ahead = np.where(new.is_finite, _compute_dots(new.gradient, batch.d), np.inf)
        there, misled = self._take_steps(batch, t, ahead, new.norm)
        taken = np.flatnonzero(there)
        if len(taken):
            some = select_columns(self.problem.device, taken, len(t))
            self._update_models(batch, new, taken, some)
            now.put_columns(taken, some, new)
        return misled | there | (batch.is_waiting & ~batch.has_ended)

    def _take_steps(self, batch: Batch, t: np.ndarray, slopes: np.ndarray, norms: np.ndarray) -> tuple[np.ndarray, ...]:
        """Accept or shorten steps of length t (b,); return masks (b,) of accepted steps and of models to be reset.

        The decision depends on `slopes` (b,) and residual `norms` (b,) after the step.
        """
        limits, now, going = self.limits, batch.state, ~(batch.is_waiting | batch.has_ended)
        far = going & is_step_too_long(slopes, batch.predicted_decrease) & (t > limits.accepted_length)
        batch.step_length = np.where(far, t * backtrack_by_slopes(slopes, batch.predicted_decrease), t)
        there, misled = going & ~far, far & (batch.step_length < limits.reset_length)
        if misled.any():  # reading from the GPU only if needed
            misled &= batch.is_updated
        well = (t > limits.min_good_step) & (norms <= limits.residual_factor * now.norm)
        eased = np.where(batch.proximal >= limits.proximal, batch.proximal / limits.proximal_growth, 0.0)
        worse = (t < limits.min_good_step) | (norms > now.norm)
        raised = np.where(misled | (there & worse), self._raise_proximal(batch.proximal), batch.proximal)
        batch.proximal, batch.steps = np.where(there & well, eased, raised), batch.steps + (misled | there)
        batch.is_stale |= there & (norms > limits.stale_factor * now.norm)
        batch.stall_counts = np.where(there & well, 0, batch.stall_counts + (misled | there))
        batch.reset_model(np.flatnonzero(misled))
        return there, misled

    def _update_models(self, batch: Batch, new: ContactState, cases: np.ndarray, index: Any) -> None:
        """Update the models with the accepted steps of cases `cases`; `index` is this selection for device arrays."""
        now = batch.state
        if batch.model is not None:
            batch.force[:, index] = batch.target_force[:, index]
            batch.response[:, index] = self._compute_response(new.smooth_gradient[:, index], batch.force[:, index])
            return
        moved, change = new.u[:, index] - now.u[:, index], new.smooth_gradient[:, index] - now.smooth_gradient[:, index]
        rest = self._compute_response(new.smooth_gradient[:, index], batch.force[:, index])
        way = rest - batch.response[:, index]
        batch.response[:, index] = rest
        positive = np.flatnonzero((_compute_dots(moved, change) > self.limits.min_curvature) & new.is_finite[cases])
        if len(positive):
            on = select_columns(self.problem.device, positive, len(cases))
            batch.history.update_history(cases[positive], moved[:, on], change[:, on], way[:, on])

    def _compute_balancing_forces(self, state: ContactState) -> Any:
        """Return the forces (3n, b) at the touched nodes that balance the gradient of the smooth terms."""
        barrier, rows = self.barrier.reduce(np.arange(len(state.norm))), self._touchable_rows
        own = to_double(state.smooth_gradient[rows])
        if barrier is None:
            return 0.0 * own
        slope = barrier.compute_gradient(to_double(state.u[rows]))
        shape = -1, 3, slope.shape[1]
        touched = (slope != 0.0).reshape(shape).any(1)
        return (-own.reshape(shape) * touched[:, None]).reshape(slope.shape)

    def _add_forces(self, smooth_gradient: Any, force: Any) -> Any:
        """Return smooth gradients (3N, b) plus the forces (3n, b) on the touchable nodes."""
        out = smooth_gradient + 0.0
        out[self._touchable_rows] += force
        return out

    def _evaluate_state(self, evaluator: ResidualEvaluator, u: Any) -> ContactState:
        """Return the contact state at u (3N, b), with residuals as in `Problem.residual`."""
        problem, device = self.problem, self.problem.device
        place, pressed = device.allocate(*u.shape), device.allocate(*u.shape)
        to_view(place)[:] = u
        found = evaluator(place)
        self.barrier.add_gradient(place, pressed)
        problem.constraint.project_nodes(pressed)
        whole = to_view(found.g)
        return ContactState(to_view(place), whole - to_view(pressed), whole, found.norm, found.scale)

    def _compute_response(self, smooth_gradient: Any, force: Any) -> Any:
        """Return the linear response (3N, b) [m] of the undeformed mesh to the residual."""
        return self.compliance.apply(self._add_forces(smooth_gradient, force))


def _compute_dots(x: Any, y: Any) -> np.ndarray:
    return to_host((x * y).sum(0)).astype(np.float64)

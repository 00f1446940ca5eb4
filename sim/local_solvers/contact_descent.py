"""Equilibrium of soft tissue and hard tools, which touch it in few nodes: a model of the one, the other as it is.

A proximal quasi-Newton method (Lee, Sun, Saunders 2014, "Proximal Newton-type methods for minimizing composite
functions", SIAM J. Optim. 24:1420-1443). Each step minimises

    s'(u) x + x . B x / 2 + c(u + x),

with s the potential of all that is smooth, B the rest stiffness and what L-BFGS has learnt since, and c the barrier of
tools, which is no model. c depends on the few nodes that tools can touch, and all else follows them. With H = B^-1 they
move by x = -H (s'(u) + f), with the tools' forces f on them as `contact_forces` finds them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.term import Local
from ..linalg.compliance import Compliance
from ..linalg.pcg import Preconditioner
from ..linalg.preconditioner import is_exact
from ..minimisers.compact_lbfgs import PairsOfColumns
from ..minimisers.lbfgs import Descended
from ..minimisers.lbfgs_kernels import BROKEN, DONE, LIVE
from ..minimisers.line_search import backtrack_by_slopes, is_step_too_long
from ..minimisers.residual import Judge, build_judge
from ..runtime.device import Device
from ..runtime.views import cast_like, from_view, run_in_order, select_columns, to_double, to_host, to_library, view
from .contact_batch import Batch, ContactState
from .contact_forces import BENT, FORCES, ContactCompliance, ForceLimits, allocate_scratch, solve_contact_forces
from .contact_limits import CONTACT, ContactLimits
from .contact_steps import PROMISED, STATUS, ContactSteps, read_step_result
from .contact_structs import CROWDED, FOUND, Scratch
from .strained_part import STRAINS, StrainedPart, StrainLimits


@dataclass(frozen=True, eq=False)
class ContactDescent:
    """A descent for a problem with one `Local` barrier, whose constraints stay closed.

    problem
        What is minimised.
    preconditioner
        Of this problem at rest, alike at every state.
    barrier
        Its only one.
    limits
        When it goes on, and when it gives up.
    strains
        Which tissue counts as strained.
    replays
        Single columns take steps that a card captures as graphs.
    """

    problem: Problem
    preconditioner: Preconditioner
    barrier: Local
    limits: ContactLimits = CONTACT
    strains: StrainLimits = STRAINS
    replays: bool = False

    @cached_property
    def compliance(self) -> Compliance:
        """At the nodes that can be touched; after them those that may be strained, if they have a model."""
        exact = is_exact(self.preconditioner)
        own = self.barrier.touchable
        nodes = self.barrier.around(self.strains.near) if exact else own
        compliance = Compliance(self.problem, self.preconditioner, nodes)
        if exact and self.problem.device.on_cuda:  # as much at once as at one node
            compliance.ensure_known(np.arange(len(nodes)) < len(own))
        return compliance

    @cached_property
    def _strained(self) -> StrainedPart | None:
        """Makes models of strained tissue; levels, whose columns take long, learn from steps instead."""
        if not is_exact(self.preconditioner):
            return None
        return StrainedPart(self.problem, self.compliance, len(self.barrier.touchable), self.strains)

    @cached_property
    def steps(self) -> ContactSteps | None:
        """Those of single columns; None where nothing is to be replayed."""
        if self._strained is None or not self.replays:
            return None
        self._strained.prepare()
        size = self._strained.size
        return ContactSteps(self.problem, self.preconditioner, self.barrier, self.compliance, size)

    @cached_property
    def _rows(self) -> Any:
        """Those (3n,) of the nodes that can be touched, on the device."""
        return self.compliance.places[: 3 * len(self.barrier.touchable)]

    @cached_property
    def _room(self) -> Callable[[int, int, int], Scratch]:
        """`allocate_scratch`, which takes long, of sizes that were asked for lately."""
        return lru_cache(2)(partial(allocate_scratch, self._exact))

    @property
    def _exact(self) -> Device:
        """The device in double precision."""
        return replace(self.problem.device, precision="float64")

    def descend(self, start: wp.array, tolerance: np.ndarray, most: int) -> Descended:
        """As `Lbfgs.descend`, in at most `most` steps of each column; nothing is learnt."""
        count, device, limits = start.shape[1], self.problem.device, self.limits
        result, live = wp.clone(start), np.arange(count)
        status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
        with run_in_order(device):
            batch = self._begun(start)
            if count == 1 and self.steps is not None:
                self._replay(self.steps, batch, tolerance, most)
            ready = np.ones(count, bool)
            while True:
                over = ready & self._ended(batch, tolerance[live], most)
                done = over & (batch.now.relative <= tolerance[live])
                if (ready & ~over).any():
                    over |= self._aimed(batch, ready & ~over, tolerance[live])
                if over.any():
                    leave = np.flatnonzero(over)
                    there = live[leave]
                    view(result)[:, there] = batch.now.u[:, leave]
                    status[there] = np.where(done, DONE, np.where(batch.now.finite, LIVE, BROKEN))[leave]
                    steps[there], residual[there] = batch.steps[leave], batch.now.relative[leave]
                    batch.gone |= over
                    if batch.gone.all():
                        return Descended(result, status, steps, residual, {})
                    if batch.gone.mean() >= limits.crowd:
                        stay = np.flatnonzero(~batch.gone)
                        batch.keep(stay)
                        live = live[stay]
                ready = self._tried(batch)

    def _begun(self, start: wp.array) -> Batch:
        judge, count = build_judge(self.problem, start), start.shape[1]
        now = self._judged(judge, view(start) + 0.0)
        force, none = self._felt(now), np.zeros(count)
        rest = self._answered(now.smooth, force)
        model = None
        if self._strained is not None and count <= self.strains.columns:
            model = self._strained.model(start, np.arange(count))
        pairs = PairsOfColumns(self.problem.device, self.problem.rows, count if model is None else 0)
        slow, steps, failed = np.zeros((3, count), int)
        stale, waiting, gone = np.zeros((3, count), bool)
        return Batch(
            judge=judge, now=now, pairs=pairs, model=model, stale=stale, force=force, rest=rest, aimed=force + 0.0,
            x=0.0 * rest, length=none, promised=none.copy(), drag=none.copy(),
            slow=slow, steps=steps, failed=failed, waiting=waiting, gone=gone,
        )  # fmt: skip

    def _replay(self, steps: ContactSteps, batch: Batch, tolerance: np.ndarray, most: int) -> None:
        """Take steps of a single column in arrays that stay, until it has come to its end.

        Or until it wants what the others do: more touched nodes than there is room for, or Newton.
        """
        known, judge, limits = None, batch.judge, self.limits
        if batch.model is None or not steps.set_tools(judge.constant):
            return
        batch.now, batch.force, batch.rest, batch.x = steps.hold(batch.now, batch.force, batch.rest)
        while not self._ended(batch, tolerance, most).any():
            self._renew(batch, np.ones(1, bool))
            if batch.model is not known:
                known = batch.model
                steps.load(known)
            said = steps.aim(self._exactly(batch, tolerance)[0], batch.drag[0], bool(self._bends(batch)[0]))
            if said[STATUS] == CROWDED:
                return
            if self._waits(batch, said[[STATUS]] != FOUND).any():
                return
            if batch.waiting.any():
                # Its model may have been forgotten.
                known = None if batch.failed[0] % limits.times == 0 else known
                continue
            batch.promised[:] = said[PROMISED]
            while True:
                t, ahead, free, scale = read_step_result(said, judge.square)
                there, misled = self._decided(batch, t, ahead, free)
                if there.any() or misled.any():
                    break
                said = steps.again(batch.length[0])
            if there.any():
                steps.move_to_last_step()
                batch.now.free[:], batch.now.scale[:] = free, scale
            else:  # it has forgotten its model
                known = None

    def _ended(self, batch: Batch, tolerance: np.ndarray, most: int) -> np.ndarray:
        """Which columns (b,) have come to their end, in equilibrium or not."""
        lost = (batch.slow >= self.limits.patience) | (batch.steps >= most) | ~batch.now.finite
        return lost | (batch.now.relative <= tolerance)

    def _renew(self, batch: Batch, wanted: np.ndarray) -> None:
        """Make stale models anew of the columns that are `wanted` (b,) bool."""
        renewed = np.flatnonzero(wanted & batch.stale)
        if batch.model is not None and self._strained is not None and len(renewed):
            fresh = self._strained.model(from_view(self.problem.device, batch.now.u), renewed)
            batch.stale &= ~wanted
            if fresh is not None:
                batch.model = batch.model.merge_columns(renewed, fresh)

    def _exactly(self, batch: Batch, tolerance: np.ndarray) -> np.ndarray:
        """To what share (b,) of themselves the tools' forces are to be found."""
        limits = self.limits
        return np.maximum(limits.forcing * np.minimum(batch.now.relative, 1.0), limits.enough * tolerance)

    def _aimed(self, batch: Batch, wanted: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
        """Give the columns that are `wanted` (b,) bool a direction; which (b,) have none, whatever was tried.

        One whose model has no equilibrium waits for the next time, dragged more; then it forgets what it has learnt. At
        last a model will do that is not convex. Others need not wait for it.
        """
        self._renew(batch, wanted)
        force, found = batch.force + 0.0, np.zeros(len(wanted), bool)
        bent = self._bends(batch)
        for some, limits in ((np.flatnonzero(wanted & ~bent), FORCES), (np.flatnonzero(wanted & bent), BENT)):
            if len(some):
                on = select_columns(self.problem.device, some, len(wanted))
                force[:, on], found[some] = self._forces(batch, some, tolerance, limits)
        over = self._waits(batch, wanted & ~found)
        some = np.flatnonzero(found)
        if len(some):
            self._direct(batch, some, force)
        return over

    def _bends(self, batch: Batch) -> np.ndarray:
        """Which columns (b,) take a model that is not convex."""
        return batch.failed >= 2 * self.limits.times

    def _waits(self, batch: Batch, waiting: np.ndarray) -> np.ndarray:
        """Increase the drag of columns (b,) bool without forces; return which (b,) have no trial left."""
        times = self.limits.times
        batch.waiting = waiting
        batch.failed = np.where(waiting, batch.failed + 1, 0)
        fresh = waiting & (batch.failed % times == 0)
        batch.forget(np.flatnonzero(fresh))
        batch.drag = np.where(fresh, 0.0, np.where(waiting, self._harder(batch.drag), batch.drag))
        return batch.failed >= 3 * times

    def _direct(self, batch: Batch, some: np.ndarray, force: Any) -> None:
        """The directions of some columns (k,) under the tools' forces (3n, b)."""
        now, device = batch.now, self.problem.device
        on = select_columns(device, some, len(batch.drag))
        if batch.model is None:
            batch.rest[:, on] += self.compliance.spread((force - batch.force)[:, on])
            batch.force[:, on] = force[:, on]
            batch.x[:, on] = -batch.rest[:, on]
        else:
            batch.aimed[:, on] = force[:, on]
            batch.x[:, on] = -batch.rest[:, on] - self.compliance.answered(self._bent(batch, force)[0])[:, on]
        if batch.pairs.most:
            learnt = batch.pairs.of(some)
            batch.x[:, on] -= learnt.motion(learnt.weights(self._pull(now.smooth, force)[:, on]))
        longest = self.problem.longest_step(from_view(device, now.u), from_view(device, batch.x))
        batch.length[some] = longest[some]
        batch.promised[some] = -_dots(now.whole[:, on], batch.x[:, on])

    def _forces(
        self, batch: Batch, some: np.ndarray, tolerance: np.ndarray, most: ForceLimits
    ) -> tuple[Any, np.ndarray]:
        """The tools' forces (3n, k) where the model of some columns (k,) is in equilibrium, and which (k,) have one."""
        rows, now = self._rows, batch.now
        on = select_columns(self.problem.device, some, len(batch.drag))
        barrier, known = self.barrier.reduced(some), batch.force[:, on]
        if barrier is None:
            return known, np.ones(len(some), bool)
        exact = self._exactly(batch, tolerance)[some]
        soft, free = ContactCompliance(self.compliance, self._exact, self._room), now.u[rows] - batch.rest[rows]
        if batch.model is not None:
            free = free - self._bent(batch, batch.force)[1]
            soft = replace(soft, own=batch.model.own[on])
        free, here = free[:, on], to_double(now.u[rows][:, on])
        if batch.pairs.most:
            learnt = batch.pairs.of(some)
            own = to_double(learnt.sw[:, :, rows])
            soft = replace(soft, learnt=own, middle=to_double(learnt.middle))
            weights = learnt.weights(self._pull(now.smooth, batch.force)[:, on])
            free = free - (to_double(weights).mT @ own)[:, 0].T
        return solve_contact_forces(barrier, soft, here, to_double(free), known, exact, batch.drag[some], most)

    def _bent(self, batch: Batch, force: Any) -> tuple[Any, Any]:
        """Forces (3N, b) [N] that the body at rest is to follow beside: those of tools that are new, and of a model.

        The second is how the nodes that can be touched move (3n, b) [m] with what the model adds.
        """
        assert batch.model is not None
        device, compliance = self.problem.device, self.compliance
        out, change = view(device.zeros(*batch.rest.shape)), force - batch.force
        near = batch.rest[compliance.places] + cast_like(batch.rest, compliance.moved(change))
        own = view(batch.model.pressed(device, from_view(device, near)))
        out[self._rows] = cast_like(out, change)
        out[compliance.places] += own
        return out, cast_like(batch.rest, compliance.moved(own)[: len(self._rows)])

    def _harder(self, drag: np.ndarray) -> np.ndarray:
        return np.maximum(self.limits.drag, self.limits.growth * drag)

    def _tried(self, batch: Batch) -> np.ndarray:
        """Try the step of every column that does not wait; which columns (b,) want another direction.

        They have taken it, as the energy still falls there, or about so. Or hardly anything is left of it after cuts:
        then they have not moved, and forget what has misled them.
        """
        now, going = batch.now, ~(batch.waiting | batch.gone)
        t = np.where(going, batch.length, 0.0)
        if not going.any():
            return batch.waiting & ~batch.gone
        new = self._judged(
            batch.judge, now.u + to_library(self.problem.device, t.astype(self.problem.device.precision)) * batch.x
        )
        ahead = np.where(new.finite, _dots(new.whole, batch.x), np.inf)
        there, misled = self._decided(batch, t, ahead, new.free)
        taken = np.flatnonzero(there)
        if len(taken):
            some = select_columns(self.problem.device, taken, len(t))
            self._learn(batch, new, taken, some)
            now.put(taken, some, new)
        return misled | there | (batch.waiting & ~batch.gone)

    def _decided(self, batch: Batch, t: np.ndarray, ahead: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, ...]:
        """Which columns (b,) take steps of a length t (b,), and which were misled; others' are cut.

        By the slopes `ahead` (b,) and the free forces (b,) there.
        """
        limits, now, going = self.limits, batch.now, ~(batch.waiting | batch.gone)
        far = going & is_step_too_long(ahead, batch.promised) & (t > limits.least)
        batch.length, there = np.where(far, t * backtrack_by_slopes(ahead, batch.promised), t), going & ~far
        misled = far & (batch.length < limits.shortest)
        if misled.any():  # a card is asked only then
            misled &= batch.learnt
        well = (t > limits.long) & (free <= limits.left * now.free)
        eased = np.where(batch.drag >= limits.drag, batch.drag / limits.growth, 0.0)
        worse = (t < limits.long) | (free > now.free)
        drag = np.where(there & well, eased, np.where(misled | (there & worse), self._harder(batch.drag), batch.drag))
        batch.drag, batch.steps = drag, batch.steps + (misled | there)
        batch.stale |= there & (free > limits.stale * now.free)
        batch.slow = np.where(there & well, 0, batch.slow + (misled | there))
        batch.forget(np.flatnonzero(misled))
        return there, misled

    def _learn(self, batch: Batch, new: ContactState, taken: np.ndarray, some: Any) -> None:
        """From steps that columns (k,) have taken to a new state; `some` are the same of an array's."""
        now = batch.now
        if batch.model is not None:
            batch.force[:, some] = batch.aimed[:, some]
            batch.rest[:, some] = self._answered(new.smooth[:, some], batch.force[:, some])
            return
        moved, change = new.u[:, some] - now.u[:, some], new.smooth[:, some] - now.smooth[:, some]
        rest = self._answered(new.smooth[:, some], batch.force[:, some])
        way = rest - batch.rest[:, some]
        batch.rest[:, some] = rest
        felt = np.flatnonzero((_dots(moved, change) > self.limits.felt) & new.finite[taken])
        if len(felt):
            on = select_columns(self.problem.device, felt, len(taken))
            batch.pairs.update_history(taken[felt], moved[:, on], change[:, on], way[:, on])

    def _felt(self, now: ContactState) -> Any:
        """Return forces (3n, b) that balance all that is smooth, where tools touch."""
        barrier, rows = self.barrier.reduced(np.arange(len(now.free))), self._rows
        own = to_double(now.smooth[rows])
        if barrier is None:
            return 0.0 * own
        slope = barrier.slope(to_double(now.u[rows]))
        shape = -1, 3, slope.shape[1]
        touched = (slope != 0.0).reshape(shape).any(1)
        return (-own.reshape(shape) * touched[:, None]).reshape(slope.shape)

    def _pull(self, smooth: Any, force: Any) -> Any:
        """Smooth gradients (3N, b) and forces (3n, b) on the touchable nodes, together (3N, b)."""
        out = smooth + 0.0
        out[self._rows] += force
        return out

    def _judged(self, judge: Judge, u: Any) -> ContactState:
        """Return the states u (3N, b), as `Problem.residual` measures them."""
        problem, device = self.problem, self.problem.device
        place, pressed = device.zeros(*u.shape), device.zeros(*u.shape)
        view(place)[:] = u
        found = judge(place)
        self.barrier.add_gradient(place, pressed)
        problem.constraint.project_nodes(pressed)
        whole = view(found.g)
        return ContactState(view(place), whole - view(pressed), whole, found.free, found.scale)

    def _answered(self, smooth: Any, force: Any) -> Any:
        """How the body at rest moves (3N, b) [m] under what is out of balance."""
        return self.compliance.answered(self._pull(smooth, force))


def _dots(x: Any, y: Any) -> np.ndarray:
    return to_host((x * y).sum(0)).astype(np.float64)

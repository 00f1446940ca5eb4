"""Equilibrium of soft tissue and hard tools, which touch it in few nodes: a model of the one, the other as it is.

A proximal quasi-Newton method (Lee, Sun, Saunders 2014, "ContactDescent Newton-type methods for minimizing composite
functions", SIAM J. Optim. 24:1420-1443). Each step minimises

    s'(u) x + x . B x / 2 + c(u + x),

with s the potential of all that is smooth, B the rest stiffness and what L-BFGS has learnt since, and c the barrier of
tools, which is no model. c depends on the few nodes that tools can touch, and all else follows them. With H = B^-1 they
move by x = -H (s'(u) + f), with the tools' forces f on them as `contact_forces` finds them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from scipy.linalg import LinAlgError

from ..discretisation.problem import Problem
from ..discretisation.term import Local
from ..linalg.compliance import Compliance
from ..linalg.pcg import Preconditioner
from ..minimisers.compact_lbfgs import Pairs, no_pairs
from ..minimisers.lbfgs import Descended
from ..minimisers.lbfgs_kernels import BROKEN, DONE, LIVE
from ..minimisers.line_search import goes_too_far, kept_of
from ..minimisers.residual import relative
from ..runtime.threads import one_thread
from .contact_forces import Softness, settled


@dataclass(frozen=True)
class ContactLimits:
    """When steps are cut, damped by a drag, and left to Newton.

    Parameters
    ----------
    cuts
        Most of one step.
    forcing, enough
        Tools' forces are exact to this share of the whole residual, or of the tolerance.
    left, long
        A step does well that leaves so much of the free force, and is not cut shorter than this.
    patience, shortest
        After so many in a row that do not, and after one that is cut to less than this, Newton goes on.
    drag, growth, times
        The first drag that is tried where one is wanted, by how much it grows and shrinks, and how often it grows.
    """

    cuts: int = 8
    forcing: float = 0.03
    enough: float = 0.1
    left: float = 0.6
    long: float = 0.5
    patience: int = 3
    shortest: float = 0.1
    drag: float = 0.3
    growth: float = 3.0
    times: int = 5


@dataclass(frozen=True, eq=False)
class State:
    """u (3N,) [m]; the free gradients (3N,) [N] of all that is smooth, and of all; its 2-norm, and its scale."""

    u: np.ndarray
    smooth: np.ndarray
    whole: np.ndarray
    free: float
    scale: float

    @property
    def relative(self) -> float:
        """The relative residual."""
        return float(relative(np.asarray(self.free), np.asarray(self.scale)))

    @property
    def finite(self) -> bool:
        """Whether it is a state at all: forces that overflow have no scale."""
        return bool(np.isfinite(self.free) and np.isfinite(self.scale))


@dataclass(frozen=True, eq=False)
class ContactDescent:
    """A descent for single loads on a problem with one `Local` barrier, whose constraints stay closed.

    problem
        What is minimised.
    preconditioner
        Of this problem at rest, alike at every state.
    barrier
        Its only one.
    limits
        When it goes on, and when it gives up.
    """

    problem: Problem
    preconditioner: Preconditioner
    barrier: Local
    limits: ContactLimits = ContactLimits()

    @cached_property
    def compliance(self) -> Compliance:
        """At the nodes that can be touched."""
        return Compliance(self.problem, self.preconditioner, self.barrier.touchable)

    def descend(self, start: wp.array, tolerance: np.ndarray, most: int) -> Descended:
        """As `Lbfgs.descend`, of one column, in at most `most` steps; nothing is learnt."""
        pairs = no_pairs(self.problem.rows, self.problem.device.precision)
        now = self._judged(start.numpy()[:, 0].astype(np.float64))
        status, step, drag, slow = LIVE if now.finite else BROKEN, 0, 0.0, 0
        # Threads of BLAS wait for one another, ages where something else runs on their cores.
        with one_thread():
            force = self._felt(now)
            rest = self._answered(now.smooth + self._everywhere(force))
            while status == LIVE:
                if now.relative <= tolerance[0]:
                    status = DONE
                if status == DONE or step >= most or slow >= self.limits.patience:
                    break
                exact = max(self.limits.forcing * min(now.relative, 1.0), self.limits.enough * tolerance[0])
                aim = self._aimed(now, force, rest, pairs, exact, drag)
                if aim is None:
                    break
                before, (force, drag) = force, aim
                rest = rest + self.compliance.spread(force - before)
                t, new = self._searched(now, -rest - pairs.motion(pairs.weights(now.smooth + self._everywhere(force))))
                if not new.finite:
                    break
                step += 1
                well = t > self.limits.long and new.free <= self.limits.left * now.free
                slow = self.limits.patience if t < self.limits.shortest else 0 if well else slow + 1
                if well:
                    drag = drag / self.limits.growth if drag >= self.limits.drag else 0.0
                elif t < self.limits.long or new.free > now.free:
                    drag = max(self.limits.drag, self.limits.growth * drag)
                if new.relative > tolerance[0]:
                    moved, change = new.u - now.u, new.smooth - now.smooth
                    way = self._answered(change)
                    rest = rest + way
                    if moved @ change > 0.0:
                        pairs = pairs.and_one(moved, change, way)
                now = new
        u = self.problem.device.array(now.u[:, None])
        return Descended(u, np.array([status]), np.array([step]), np.array([now.relative]), {})

    def _aimed(
        self, now: State, force: np.ndarray, rest: np.ndarray, pairs: Pairs, tolerance: float, drag: float
    ) -> tuple[np.ndarray, float] | None:
        """The tools' forces (3n,) where the model is in equilibrium, and the drag that this takes.

        `rest` (3N,) [m] is what the body at rest answers the smooth gradient and a `force` (3n,) with. None where no
        drag makes the model convex.
        """
        barrier, rows = self.barrier.reduced(), self.compliance.rows
        if barrier is None:
            return np.zeros_like(force), drag
        free = now.u - rest - pairs.motion(pairs.weights(now.smooth + self._everywhere(force)))
        soft = Softness(self.compliance, pairs)
        for _ in range(self.limits.times):
            try:
                found = settled(barrier, soft, now.u[rows], free[rows], force, tolerance, drag)
            except LinAlgError:  # steps so small that what is learnt from them is round-off
                return None
            if found is not None:
                return found, drag
            drag = max(self.limits.drag, self.limits.growth * drag)
        return None

    def _felt(self, now: State) -> np.ndarray:
        """Forces (3n,) that balance all that is smooth, where tools touch."""
        barrier, rows = self.barrier.reduced(), self.compliance.rows
        if barrier is None:
            return np.zeros(len(rows))
        touched = barrier.slope(now.u[rows]).reshape(-1, 3).any(axis=1)
        return np.where(np.repeat(touched, 3), -now.smooth[rows], 0.0)

    def _everywhere(self, force: np.ndarray) -> np.ndarray:
        """A force (3n,) on the touchable nodes as one (3N,) on all."""
        whole = np.zeros(self.problem.rows)
        whole[self.compliance.rows] = force
        return whole

    def _searched(self, now: State, x: np.ndarray) -> tuple[float, State]:
        """How far along a step x (3N,) the energy still falls, or about so, and the state there."""
        device = self.problem.device
        t = float(self.problem.longest_step(device.array(now.u[:, None]), device.array(x[:, None]))[0])
        promised = -float(now.whole @ x)
        new = self._judged(now.u + t * x)
        for _ in range(self.limits.cuts):
            ahead = float(new.whole @ x) if new.finite else np.inf
            if not goes_too_far(ahead, promised):
                break
            t *= kept_of(ahead, promised)
            new = self._judged(now.u + t * x)
        return t, new

    def _answered(self, force: np.ndarray) -> np.ndarray:
        """How the body at rest moves (3N,) [m] under a force (3N,) [N]."""
        return self.compliance.answered(force[:, None])[:, 0].astype(np.float64)

    def _judged(self, u: np.ndarray) -> State:
        """The state u (3N,), as `Problem.residual` measures it."""
        problem, device = self.problem, self.problem.device
        place, parts, scale = device.array(u[:, None]), np.zeros((problem.rows, 2)), 0.0
        for term in problem.terms:
            own = device.zeros(problem.rows, 1)
            term.add_gradient(place, own)
            force = own.numpy()[:, 0]
            parts[:, int(term is self.barrier)] += force
            scale = max(scale, float(np.linalg.norm(force)))
        both = device.array(parts)
        problem.constraint.project_nodes(both)
        free = both.numpy().astype(np.float64)
        smooth, whole = free[:, 0], free.sum(axis=1)
        size, all_of_it = float(np.linalg.norm(whole)), float(np.linalg.norm(parts.sum(axis=1)))
        return State(u, smooth, whole, size, max(scale, np.sqrt(max(all_of_it**2 - size**2, 0.0))))

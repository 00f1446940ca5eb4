"""Nonlinear elimination without an inverse: what a load strains much is in equilibrium before the body around it moves.

Where the rest stiffness is known only nearly (levels), the surroundings of a part cannot be condensed. So the part of
the body near a load, held at its rim (`clamped_part.py`), is brought to equilibrium by itself, and L-BFGS minimises
what is left, a function of the body around it, whose curvature the rest stiffness knows well. Cai, Keyes 2002,
"Nonlinearly preconditioned inexact Newton algorithms", SIAM J. Sci. Comput. 24:183-200.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import warp as wp

from ..discretisation.element import linear_elements
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.pcg import Preconditioner
from ..minimisers.lbfgs import Descended
from ..minimisers.lbfgs_kernels import BROKEN, DONE, LIVE
from ..minimisers.line_search import goes_too_far, kept_of
from ..minimisers.residual import State, constants_of
from ..runtime.columns import combined, dots
from .clamped_part import Rimmed

# The vicinity is what the linear answer strains more than this, the most strained tetrahedra first, of at most such a
# share of all nodes; and all tetrahedra that touch these.
STRAINED, LARGEST = 0.15, 0.03
# Where a cycle leaves more than this share of the free force, and so many nodes have most of what is beyond the
# vicinity, these and what touches them are added to it.
LEFT, ADDED = 0.8, 60
CYCLES, PAIRS, CUTS = 30, 8, 6
# A load whose free force was not halved in so many cycles goes elsewhere.
PATIENCE = 8
# The vicinity is settled to a share of the whole residual, or of the tolerance.
FORCING, ENOUGH = 0.1, 0.5


@dataclass(frozen=True, eq=False)
class Vicinity:
    """A descent for single loads on one problem: quadratic elements, whose rest stiffness has levels and no inverse.

    problem, preconditioner
        The whole body's.
    effects, space
        What the problem was compiled from.
    """

    problem: Problem
    preconditioner: Preconditioner
    effects: Iterable[Effect]
    space: Discretisation

    def descend(
        self, start: wp.array, tolerance: np.ndarray, most: int, learnt: Mapping[str, np.ndarray] | None = None
    ) -> Descended:
        """As `Lbfgs.descend`, of one column, in at most `most` cycles; nothing is learnt.

        What is not brought to its end is left where its free force was least.
        """
        constant, _ = constants_of(self.problem, start)
        first = best = now = self._at(start)
        aim, status, cycle, idle, mark = float(tolerance[0]), LIVE if first.finite else BROKEN, 0, 0, np.inf
        chosen, pairs = np.zeros(len(self.space.table), bool), Pairs(self.problem)
        if first.finite:
            linear = combined(self.problem.device, start, -1.0, self._solved(now.g), wp.empty_like(start))
            chosen = self._touching(self._strained(linear))
        if not chosen.any():
            return _ended(best, status, cycle)
        part = Rimmed(self.problem, self.effects, self.space, chosen, constant, start)
        now = self._at(part.settled(now.u, FORCING * now.free))
        while now.finite:
            best = now if now.free <= best.free else best
            status = DONE if best.relative <= aim else LIVE
            halved = now.free <= 0.5 * mark
            mark, idle = (now.free, 0) if halved else (mark, idle + 1)
            if status == DONE or idle >= PATIENCE or cycle >= min(CYCLES, most):
                break
            cycle += 1
            new = self._lower(now, part, pairs, max(FORCING * now.free, ENOUGH * aim * now.scale))
            if new is None:
                break
            pairs.learn(now, new)
            if new.free > LEFT * now.free:
                more = self._left(new.g, part.nodes)
                if len(more):
                    chosen |= self._touching(more)
                    part = Rimmed(self.problem, self.effects, self.space, chosen, constant, new.u)
            now = new
        return _ended(best, status, cycle)

    def _lower(self, now: State, part: Rimmed, pairs: Pairs, force: float) -> State | None:
        """A step along the direction of L-BFGS that does not go too far, and the part settled to `force` [N] there.

        None where no step that was tried leads on.
        """
        d, promised = pairs.direction(now.g, self._solved)
        if not promised > 0.0:
            return None
        device, length = self.problem.device, float(self.problem.longest_step(now.u, d)[0])
        for _ in range(CUTS):
            v = combined(device, now.u, length, d, wp.empty_like(d))
            new = self._at(part.settled(v, force))
            slope = float(dots(device, new.g, d)[0])
            if new.finite and not goes_too_far(slope, promised):
                return new
            length *= kept_of(slope, promised)
        return None

    def _at(self, u: wp.array) -> State:
        g, free, scale = self.problem.residual(u)
        return State(u, g, float(free[0]), float(scale[0]))

    def _solved(self, g: wp.array) -> wp.array:
        z = wp.zeros_like(g)
        self.preconditioner.apply(g, np.ones(1, bool), z)
        self.problem.constraint.project_nodes(z)
        return z

    def _strained(self, u: wp.array) -> np.ndarray:
        """The nodes (k,) of the tetrahedra that a displacement u (3N, 1) strains most."""
        table = self.space.table
        slope = np.einsum("tai,taj->tij", u.numpy().reshape(-1, 3)[table[:, :4]], self._slopes)
        strain = np.sqrt(np.einsum("tij,tij->t", slope, slope))
        most = min(int(LARGEST * len(strain)), int((strain > STRAINED).sum()))
        return table[np.argsort(-strain)[:most]].ravel()

    def _left(self, g: wp.array, nodes: np.ndarray) -> np.ndarray:
        """The few nodes (k,) beyond these that have most of the free gradient g (3N, 1) there; none if no few have."""
        square = (g.numpy().reshape(-1, 3).astype(np.float64) ** 2).sum(axis=1)
        square[nodes] = 0.0
        most = np.argsort(-square)[:ADDED]
        return most if 2.0 * square[most].sum() > square.sum() else most[:0]

    def _touching(self, nodes: np.ndarray) -> np.ndarray:
        """(T,) bool: the tetrahedra of these nodes (k,)."""
        touched = np.zeros(self.space.count, bool)
        touched[nodes] = True
        return touched[self.space.table].max(axis=1)

    @cached_property
    def _slopes(self) -> np.ndarray:
        every = np.ones(len(self.space.mesh.tets), bool)
        return linear_elements(self.space.mesh, every).gradient[:, 0].astype(np.float32)


def _ended(best: State, status: int, cycle: int) -> Descended:
    return Descended(best.u, np.array([status]), np.array([cycle]), np.array([best.relative]), {})


@dataclass(eq=False)
class Pairs:
    """The last pairs of L-BFGS: steps s and changes y of the gradient (3N, 1)."""

    problem: Problem
    known: list[tuple[wp.array, wp.array]] = field(default_factory=list)

    def learn(self, before: State, after: State) -> None:
        """What the step between two states says of the curvature."""
        device = self.problem.device
        s = combined(device, after.u, -1.0, before.u, wp.empty_like(after.u))
        y = combined(device, after.g, -1.0, before.g, wp.empty_like(after.g))
        if after.finite and float(dots(device, s, y)[0]) > 0.0:
            self.known = [*self.known, (s, y)][-PAIRS:]

    def direction(self, g: wp.array, solved: Callable[[wp.array], wp.array]) -> tuple[wp.array, float]:
        """The direction (3N, 1), and the decrease that it promises. Nocedal, Wright 2006, algorithm 7.4."""
        device, q, along = self.problem.device, wp.clone(g), []
        for s, y in reversed(self.known):
            share = float(dots(device, s, q)[0] / dots(device, s, y)[0])
            combined(device, q, -share, y, q)
            along.append(share)
        z = solved(q)
        for (s, y), share in zip(self.known, reversed(along), strict=True):
            combined(device, z, share - float(dots(device, y, z)[0] / dots(device, s, y)[0]), s, z)
        promised = float(dots(device, g, z)[0])
        return combined(device, wp.zeros_like(z), -1.0, z, z), promised

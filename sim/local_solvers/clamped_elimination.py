"""Nonlinear elimination without an inverse: what a load strains much is in equilibrium before the body around it moves.

Where the rest stiffness is known only nearly (levels), the surroundings of a part cannot be condensed. So the part of
the body near a load, held at its rim (`clamped_part.py`), is brought to equilibrium by itself. L-BFGS minimises what is
left, a function of the body around it, whose curvature the rest stiffness knows well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import warp as wp

from ..discretisation.element import build_linear_elements
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.pcg import Preconditioner
from ..minimisers.compact_lbfgs import build_empty_history
from ..minimisers.lbfgs import Descended
from ..minimisers.line_search import backtrack_by_slopes, is_step_too_long
from ..minimisers.residual import Judge, ResidualState
from ..runtime.columns import combine_columns
from .clamped_part import ClampedPart
from .outer_loop import CycleLimits, run_cycles


@dataclass(frozen=True)
class ClampedSize:
    """Which tissue is clamped off, and how often a step of the whole is cut.

    Parameters
    ----------
    strained, largest
        What the linear answer strains more than this, the most strained tetrahedra first, of at most this share of all;
        and all tetrahedra that touch these.
    left, added
        A cycle may leave more than this share of the free force, and so many nodes may have most of what is beyond the
        part. Then these and what touches them are added to it.
    cuts
        Most of one step.
    """

    strained: float = 0.15
    largest: float = 0.03
    left: float = 0.8
    added: int = 60
    cuts: int = 6


DEAR = CycleLimits(cycles=30, patience=8, rise=1e6, forcing=0.1, enough=0.5)


@dataclass(frozen=True, eq=False)
class ClampedElimination:
    """A descent for single loads on one problem: quadratic elements, whose rest stiffness has levels and no inverse.

    problem, preconditioner
        The whole body's.
    effects, space
        What the problem was compiled from.
    limits, size
        When cycles end: one is dear here, and the line search cuts what explodes. Which part is clamped off.
    """

    problem: Problem
    preconditioner: Preconditioner
    effects: Iterable[Effect]
    space: Discretisation
    limits: CycleLimits = DEAR
    size: ClampedSize = ClampedSize()

    def descend(
        self, start: wp.array, tolerance: np.ndarray, most: int, learnt: Mapping[str, np.ndarray] | None = None
    ) -> Descended:
        """As `Lbfgs.descend`, of one column, in at most `most` cycles; nothing is learnt."""
        chosen, part, pairs = (
            np.zeros(len(self.space.table), bool),
            None,
            build_empty_history(self.problem.rows, self.problem.device.precision),
        )
        z = np.zeros(0)

        def cycle(judge: Judge, now: ResidualState, force: np.ndarray) -> ResidualState:
            nonlocal chosen, part, pairs, z
            if part is None:
                z = self._solved(now.g)
                chosen = self._touching(self._strained(now.u.numpy()[:, 0] - z))
                if not chosen.any():
                    return replace(now, free=np.full(1, np.inf))
                part = ClampedPart(self.problem, self.effects, self.space, chosen, judge.constant, now.u)
                new = judge(part.settled(now.u, force[0]))
                z = self._solved(new.g)
                return new
            new = self._lower(judge, now, part, -z - pairs.motion(pairs.weights(_host(now.g))), force[0])
            if not new.finite[0]:
                return new
            after = self._solved(new.g)
            s, y = _host(new.u) - _host(now.u), _host(new.g) - _host(now.g)
            if s @ y > 0.0:
                pairs = pairs.add_pair(s, y, after - z)
            if new.free[0] > self.size.left * now.free[0]:
                more = self._left(_host(new.g), part.nodes)
                if len(more):
                    chosen |= self._touching(more)
                    part = ClampedPart(self.problem, self.effects, self.space, chosen, judge.constant, new.u)
            z = after
            return new

        return run_cycles(self.problem, start, tolerance, most, self.limits, cycle)

    def _lower(self, judge: Judge, now: ResidualState, part: ClampedPart, d: np.ndarray, force: float) -> ResidualState:
        """Return a step along d (3N,) that does not go too far, and the part settled to `force` [N] there.

        Its free force is not finite where no step that was tried leads on.
        """
        promised, device = -float(_host(now.g) @ d), self.problem.device
        way = device.array(d[:, None])
        length = float(self.problem.longest_step(now.u, way)[0])
        for _ in range(self.size.cuts if promised > 0.0 else 0):
            new = judge(part.settled(combine_columns(device, now.u, length, way, wp.empty_like(way)), force))
            slope = float(_host(new.g) @ d)
            if new.finite[0] and not is_step_too_long(slope, promised):
                return new
            length *= backtrack_by_slopes(slope, promised)
        return replace(now, free=np.full(1, np.inf))

    def _solved(self, g: wp.array) -> np.ndarray:
        """How the body at rest answers a force g (3N, 1) [N]: (3N,) [m]."""
        z = wp.zeros_like(g)
        self.preconditioner.apply(g, np.ones(1, bool), z)
        self.problem.constraint.project_nodes(z)
        return _host(z)

    def _strained(self, u: np.ndarray) -> np.ndarray:
        """Return the nodes (k,) of the tetrahedra that a displacement u (3N,) [m] strains most."""
        table = self.space.table
        slope = np.einsum("tai,taj->tij", u.reshape(-1, 3)[table[:, :4]], self._slopes)
        strain = np.sqrt(np.einsum("tij,tij->t", slope, slope))
        most = min(int(self.size.largest * len(strain)), int((strain > self.size.strained).sum()))
        return table[np.argsort(-strain)[:most]].ravel()

    def _left(self, g: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the few nodes (k,) beyond these that have most of the free gradient g (3N,) there.

        None if no few have.
        """
        square = (g.reshape(-1, 3).astype(np.float64) ** 2).sum(axis=1)
        square[nodes] = 0.0
        most = np.argsort(-square)[: self.size.added]
        return most if 2.0 * square[most].sum() > square.sum() else most[:0]

    def _touching(self, nodes: np.ndarray) -> np.ndarray:
        """(T,) bool: the tetrahedra of these nodes (k,)."""
        touched = np.zeros(self.space.count, bool)
        touched[nodes] = True
        return touched[self.space.table].max(axis=1)

    @cached_property
    def _slopes(self) -> np.ndarray:
        every = np.ones(len(self.space.mesh.tets), bool)
        return build_linear_elements(self.space.mesh, every).gradient[:, 0].astype(np.float32)


def _host(column: wp.array) -> np.ndarray:
    """(3N,) of a column (3N, 1) on the CPU."""
    return column.numpy()[:, 0]

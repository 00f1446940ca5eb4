"""Nonlinear elimination of the few hundred nodes that one load strains most: its patch is settled, the body follows.

Far from rest are only the nodes close to a tool. Each cycle corrects the body with its rest stiffness, brings the patch
to equilibrium beside it (`patch.py`), and lets the body follow the forces that this takes. It takes two to five looks
at all of it instead of five to twenty. `batch_elimination.py` does so for batches, with one part for all loads.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.multifrontal import Factor
from ..minimisers.lbfgs import Descended
from ..minimisers.residual import Judge, State
from ..runtime.columns import combined
from ..runtime.threads import one_thread
from .batch_elimination import NEAR, near_tetrahedra
from .outer_loop import USUAL, Limits, eliminated
from .patch import Patch, patch_of

# What a descent has learnt: the nodes (1, n) of its patch.
NODES = "patch"


@dataclass(frozen=True)
class PatchSize:
    """Which nodes a patch may have.

    Parameters
    ----------
    largest, negligible
        Most nodes, and fewer where what lies beyond has this share of the forces.
    left
        A patch stays while each cycle leaves at most this share of the free force.
    near
        About so many nodes may be in patches at all: their compliance has three times as many rows. Of the default
        brain's 1,244 it takes a second and 55 MB.
    """

    largest: int = 550
    negligible: float = 0.02
    left: float = 0.3
    near: int = 2000


SIZE = PatchSize()


class PatchElimination:
    """A descent for single loads on one problem, on the CPU.

    Parameters
    ----------
    problem, factor
        The whole body, and its rest stiffness.
    effects, space
        What the problem was compiled from.
    near
        (T,) bool: the tetrahedra that a patch may be made of.
    limits, size
        When cycles end; how large a patch may be.
    """

    def __init__(
        self,
        problem: Problem,
        factor: Factor,
        effects: Iterable[Effect],
        space: Discretisation,
        near: np.ndarray,
        limits: Limits = USUAL,
        size: PatchSize = SIZE,
    ):
        self._problem, self._factor, self._effects, self._space = problem, factor, tuple(effects), space
        self._limits, self._size = limits, size
        self._near, self._table = np.flatnonzero(near), space.table[near]
        self.nodes = np.unique(self._table)
        """Those (n,) that a patch may be made of, ascending."""
        self._rows = (3 * self.nodes[:, None] + np.arange(3)).ravel()
        self._last: tuple[np.ndarray, Patch, np.ndarray] | None = None
        self._compliance = factor.compliance(self._rows)
        # A patch's rows of it, and its own columns of these: the last patch stands there.
        rows, kind = min(3 * size.largest, len(self._rows)), self._compliance.dtype
        self._room = np.empty((rows, len(self._rows)), kind), np.empty(rows**2, kind)

    def descend(
        self, start: wp.array, tolerance: np.ndarray, most: int, learnt: Mapping[str, np.ndarray] | None = None
    ) -> Descended:
        """As `Lbfgs.descend`, of one column, in at most `most` cycles; what is learnt is the patch."""
        nodes, forces = self._known(learnt), np.zeros(len(start) // 3)

        def cycle(judge: Judge, now: State, force: np.ndarray) -> State:
            nonlocal nodes, forces
            new, nodes, here = self._cycle(judge, now, nodes, float(force[0]))
            if new.finite[0]:
                forces = np.maximum(forces, here / np.linalg.norm(here))
                if nodes is not None and new.free[0] > self._size.left * now.free[0]:
                    nodes = self._strained(forces)
            return new

        found = eliminated(self._problem, start, tolerance, most, self._limits, cycle)
        return found if learnt is None or nodes is None else replace(found, learnt={NODES: nodes[None]})

    def _cycle(
        self, judge: Judge, now: State, nodes: np.ndarray | None, force: float
    ) -> tuple[State, np.ndarray | None, np.ndarray]:
        """The next state, the nodes of the patch, and forces (N,) [N]: what is out of balance then, or the patch took.

        There is none where the rest stiffness alone leaves no more than `force` [N], as much as one may leave.
        """
        device = self._problem.device
        if nodes is None:
            ahead = self._answered(judge, now.u, combined(device, now.g, -2.0, now.g, wp.empty_like(now.g)))
            if ahead.free[0] <= force:
                return ahead, None, _norms(ahead.g)
            nodes = self._strained(_norms(ahead.g))
        patch, reach = self._patch(nodes)
        u, g = now.u.numpy()[:, 0], now.g.numpy()[:, 0]
        with one_thread():
            e = -(reach @ g[self._rows].astype(reach.dtype)).astype(g.dtype)
            share, own = patch.settled(u[patch.rows], e, force)
        pull = device.array(-share * g[:, None])
        pull.numpy()[patch.rows, 0] += own
        new = self._answered(judge, now.u, pull)
        forces = _norms(new.g)
        forces[patch.nodes] = np.linalg.norm(own.reshape(-1, 3).astype(np.float64), axis=1)
        return new, nodes, forces

    def _answered(self, judge: Judge, u: wp.array, force: wp.array) -> State:
        """Where the body moves from u (3N, 1) [m] under a force (3N, 1) [N], at rest, or as far as terms allow."""
        problem, device, step = self._problem, self._problem.device, self._problem.device.zeros(*u.shape)
        self._factor.apply(force, np.ones(1, bool), step)
        problem.constraint.project_nodes(step)  # what is rounded row by row leaves the planes it slides on
        new = judge(combined(device, u, 1.0, step, wp.empty_like(step)))
        if new.finite[0]:
            return new
        return judge(combined(device, u, float(problem.longest_step(u, step)[0]), step, step))

    def _strained(self, forces: np.ndarray) -> np.ndarray:
        """The nodes (k,), ascending, of those tetrahedra that have the largest `forces` (N,) at their nodes."""
        size = forces[self._table].sum(axis=1)
        size[~np.isfinite(size)] = np.inf
        order = np.argsort(-size, kind="stable")
        with np.errstate(over="ignore"):
            rest = np.cumsum(size[order][::-1] ** 2)[::-1]
        some = (
            order[: max(1, int((rest > self._size.negligible**2 * rest[0]).sum()))] if np.isfinite(rest[0]) else order
        )
        nodes, first = np.unique(self._table[some], return_index=True)
        return np.sort(nodes[np.argsort(first)[: self._size.largest]])

    def _known(self, learnt: Mapping[str, np.ndarray] | None) -> np.ndarray | None:
        """The nodes of a patch that served before, if that was here."""
        nodes = (learnt or {}).get(NODES)
        if nodes is None or nodes.shape[1] > self._size.largest or not np.isin(nodes, self.nodes).all():
            return None
        return nodes[0]

    def _patch(self, nodes: np.ndarray) -> tuple[Patch, np.ndarray]:
        """All tetrahedra of the near part on these nodes; and how they move (m, M) [m/N] with forces on all of it."""
        if self._last is None or not np.array_equal(self._last[0], nodes):
            chosen = np.zeros(len(self._space.table), bool)
            chosen[self._near] = np.isin(self._table, nodes).all(axis=1)
            place = np.searchsorted(self.nodes, np.unique(self._space.table[chosen]))
            rows = (3 * place[:, None] + np.arange(3)).ravel()
            self._last = None
            reach, own = self._room[0][: len(rows)], self._room[1][: len(rows) ** 2].reshape(len(rows), len(rows))
            np.take(self._compliance, rows, axis=0, out=reach, mode="clip")
            np.take(reach, rows, axis=1, out=own, mode="clip")
            patch = patch_of(self._effects, self._space, self._problem, chosen, own)
            self._last = nodes, patch, reach
        return self._last[1:]


def patch_elimination(
    problem: Problem, factor: Factor, effects: Iterable[Effect], space: Discretisation, size: PatchSize = SIZE
) -> PatchElimination:
    """For single loads on the CPU, on a body with a small opening."""
    near = near_tetrahedra(space, problem.constraint, min(NEAR.share, size.near / space.count))
    return PatchElimination(problem, factor, effects, space, near, size=size)


def _norms(force: wp.array) -> np.ndarray:
    """The size (N,) [N] of a force (3N, 1) at each node."""
    return np.linalg.norm(force.numpy().reshape(-1, 3), axis=1)

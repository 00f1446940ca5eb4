"""Nonlinear elimination without an exact inverse: strained tissue is brought to equilibrium before other nodes move.

Multigrid inverts the undeformed stiffness only approximately, so the far part cannot be condensed. Therefore the part
near a load is clamped at its boundary (`clamped_part.py`) and solved as a local subproblem. L-BFGS minimises the energy
as a function of the other nodes, whose curvature is close to the undeformed stiffness.
"""

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
from ..minimisers.lbfgs import DescentResult
from ..minimisers.line_search import backtrack_by_slopes, is_step_too_long
from ..minimisers.residual import ResidualEvaluator, ResidualState
from ..runtime.columns import combine_columns
from .clamped_part import ClampedPart
from .outer_loop import CycleLimits, run_cycles


@dataclass(frozen=True)
class ClampedSize:
    """Size of the clamped part, and number of backtracking steps.

    Parameters
    ----------
    min_strain, max_fraction
        Tetrahedra belong to the part if the displacement gradient of the linear solution has a larger norm than
        `min_strain`; at most this fraction, the most strained first. Tetrahedra that touch these are added.
    residual_factor, max_added_nodes
        If a cycle leaves more than this fraction of the residual, and at most this number of nodes outside the part
        have most of the residual, the tetrahedra that touch these nodes are added to the part.
    max_backtracks
        Maximum number of backtracking steps per step.
    """

    min_strain: float = 0.15
    max_fraction: float = 0.03
    residual_factor: float = 0.8
    max_added_nodes: int = 60
    max_backtracks: int = 6


# Few cycles, because each is expensive; the line search already rejects steps whose forces explode.
CLAMPED_CYCLE_LIMITS = CycleLimits(max_cycles=30, patience=8, max_rise=1e6, forcing=0.1, tolerance_factor=0.5)


@dataclass(frozen=True, eq=False)
class ClampedElimination:
    """Solver of single loads for quadratic elements, whose undeformed stiffness multigrid inverts approximately.

    problem, preconditioner
        Problem of the whole mesh, and its preconditioner.
    effects, space
        Effects and discretisation from which the problem was compiled.
    limits, size
        Limits of the cycles; size of the clamped part.
    """

    problem: Problem
    preconditioner: Preconditioner
    effects: Iterable[Effect]
    space: Discretisation
    limits: CycleLimits = CLAMPED_CYCLE_LIMITS
    size: ClampedSize = ClampedSize()

    def descend(
        self, start: wp.array, tolerance: np.ndarray, max_iter: int, warm_start: Mapping[str, np.ndarray] | None = None
    ) -> DescentResult:
        """Return the result as `Lbfgs.descend`, for one load case, after at most `max_iter` cycles; without history."""
        chosen, part = np.zeros(len(self.space.table), bool), None
        pairs, z = build_empty_history(self.problem.rows, self.problem.device.precision), np.zeros(0)

        def run_cycle(evaluate: ResidualEvaluator, state: ResidualState, tolerance: np.ndarray) -> ResidualState:
            nonlocal chosen, part, pairs, z
            if part is None:
                z = self._compute_response(state.g)
                chosen = self._mark_adjacent_tets(self._find_strained_nodes(state.u.numpy()[:, 0] - z))
                if not chosen.any():
                    return replace(state, norm=np.full(1, np.inf))
                part = ClampedPart(self.problem, self.effects, self.space, chosen, evaluate.constant, state.u)
                new = evaluate(part.solve_part(state.u, tolerance[0]))
                z = self._compute_response(new.g)
                return new
            d = -z - pairs.compute_motion(pairs.compute_weights(_copy_to_host(state.g)))
            new = self._search_line(evaluate, state, part, d, tolerance[0])
            if not new.is_finite[0]:
                return new
            after = self._compute_response(new.g)
            s, y = _copy_to_host(new.u) - _copy_to_host(state.u), _copy_to_host(new.g) - _copy_to_host(state.g)
            if s @ y > 0.0:
                pairs = pairs.add_pair(s, y, after - z)
            if new.norm[0] > self.size.residual_factor * state.norm[0]:
                more = self._find_residual_nodes(_copy_to_host(new.g), part.nodes)
                if len(more):
                    chosen |= self._mark_adjacent_tets(more)
                    part = ClampedPart(self.problem, self.effects, self.space, chosen, evaluate.constant, new.u)
            z = after
            return new

        return run_cycles(self.problem, start, tolerance, max_iter, self.limits, run_cycle)

    def _search_line(
        self, evaluate: ResidualEvaluator, state: ResidualState, part: ClampedPart, d: np.ndarray, tolerance: float
    ) -> ResidualState:
        """Return the state accepted by a line search along d (3N,), the part solved to `tolerance` [N] at each trial.

        The residual of the returned state is not finite if no trial step is accepted.
        """
        predicted, device = -float(_copy_to_host(state.g) @ d), self.problem.device
        way = device.upload(d[:, None])
        length = float(self.problem.longest_step(state.u, way)[0])
        for _ in range(self.size.max_backtracks if predicted > 0.0 else 0):
            trial = combine_columns(device, state.u, length, way, wp.empty_like(way))
            new = evaluate(part.solve_part(trial, tolerance))
            slope = float(_copy_to_host(new.g) @ d)
            if new.is_finite[0] and not is_step_too_long(slope, predicted):
                return new
            length *= backtrack_by_slopes(slope, predicted)
        return replace(state, norm=np.full(1, np.inf))

    def _compute_response(self, g: wp.array) -> np.ndarray:
        """Return the linear response (3N,) [m] of the undeformed mesh to a force g (3N, 1) [N]."""
        z = wp.zeros_like(g)
        self.preconditioner.apply(g, np.ones(1, bool), z)
        self.problem.constraint.project_nodes(z)
        return _copy_to_host(z)

    def _find_strained_nodes(self, u: np.ndarray) -> np.ndarray:
        """Return the nodes (k,) of the tetrahedra that are strained most at the displacement u (3N,) [m]."""
        table = self.space.table
        slope = np.einsum("tai,taj->tij", u.reshape(-1, 3)[table[:, :4]], self._shape_gradients)
        strain = np.sqrt(np.einsum("tij,tij->t", slope, slope))
        most = min(int(self.size.max_fraction * len(strain)), int((strain > self.size.min_strain).sum()))
        return table[np.argsort(-strain)[:most]].ravel()

    def _find_residual_nodes(self, g: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the few nodes (k,) outside the part that have most of the residual g (3N,) outside the part.

        The result is empty if the residual is spread over more nodes.
        """
        square = (g.reshape(-1, 3).astype(np.float64) ** 2).sum(axis=1)
        square[nodes] = 0.0
        most = np.argsort(-square)[: self.size.max_added_nodes]
        return most if 2.0 * square[most].sum() > square.sum() else most[:0]

    def _mark_adjacent_tets(self, nodes: np.ndarray) -> np.ndarray:
        """Return a mask (T,) of the tetrahedra that contain any of the `nodes` (k,)."""
        touched = np.zeros(self.space.count, bool)
        touched[nodes] = True
        return touched[self.space.table].max(axis=1)

    @cached_property
    def _shape_gradients(self) -> np.ndarray:
        every = np.ones(len(self.space.mesh.tets), bool)
        return build_linear_elements(self.space.mesh, every).gradient[:, 0].astype(np.float32)


def _copy_to_host(column: wp.array) -> np.ndarray:
    """Return a copy (3N,) of a column (3N, 1) on the CPU."""
    return column.numpy()[:, 0]

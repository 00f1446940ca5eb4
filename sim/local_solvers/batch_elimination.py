"""Nonlinear elimination: the most strained part is a repeated local subproblem, which the remaining mesh follows.

Close to the tools tissue is far from its undeformed stiffness, elsewhere it is nearly linear. A descent from the
undeformed stiffness spends most of its iterations on the near part, at the cost of the whole mesh. Here each cycle
corrects the whole with the undeformed stiffness, then solves the near part within the linear far part. The far part
follows: Gendre, Allix, Gosselet, Comte 2009, "Non-intrusive and exact global/local techniques for structural problems
with local plasticity", Comput. Mech. 44:233-245. The outer loop is that of nonlinear elimination (`outer_loop.py`).

C is the inverse of the undeformed stiffness, r the gradient at u, and e = -C r the linear correction. The near part
solves n(u + x) - n(u) + F x = (n' + F) e for x. Here n are its internal forces, n' its undeformed stiffness, and F that
of the far part, condensed. The far part takes e + H (x - e), where H maps the shared rows to the far part. If n were
linear, x would be e.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ..compile import LocalProblem, add_surrounding_stiffness, compile_part
from ..discretisation.constraint import Constraint
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.pcg import Preconditioner
from ..linalg.preconditioner import build_rest_solver
from ..linalg.schur import condense_exterior
from ..minimisers.lbfgs import DescentResult, Lbfgs
from ..minimisers.residual import ResidualEvaluator, ResidualState
from ..runtime.columns import combine_columns, put_rows, take_rows
from ..runtime.dense_product import build_product
from .outer_loop import DEFAULT_CYCLE_LIMITS, CycleLimits, run_cycles


@dataclass(frozen=True)
class NearPart:
    """Extent of the near part, and limits of its solution.

    Parameters
    ----------
    fraction, max_opening
        Fraction of the tetrahedra; largest fraction of surface vertices that may be free.
    max_iterations, straggler_fraction
        Maximum L-BFGS iterations in one cycle, which ends earlier if at most this fraction of the load cases is live.
    """

    fraction: float = 0.2
    max_opening: float = 0.25
    max_iterations: int = 100
    straggler_fraction: float = 0.05


NEAR_PART = NearPart()  # Default.


@dataclass(frozen=True, eq=False)
class BatchElimination:
    """Solver for problems that are nonlinear in a small region.

    problem, preconditioner
        Whole problem, and its inverse undeformed stiffness.
    rows
        (3n,) on the device: rows of the near part among the whole's 3N.
    part, lbfgs
        Near part within the condensed far part, and the solver of this subproblem.
    shared_rows, extend
        (m,) rows of the near part shared with the far part, on the device; (x (m, b), out (3N, b)): the far part's
        motion.
    limits, size
        Limits of the cycles; extent and limits of the near part.
    """

    problem: Problem
    preconditioner: Preconditioner
    rows: wp.array
    part: LocalProblem
    lbfgs: Lbfgs
    shared_rows: wp.array
    extend: Callable[[wp.array, wp.array], None]
    limits: CycleLimits = DEFAULT_CYCLE_LIMITS
    size: NearPart = NEAR_PART

    def descend(
        self, start: wp.array, tolerance: np.ndarray, max_iter: int, warm_start: Mapping[str, np.ndarray] | None = None
    ) -> DescentResult:
        """Solve as `Lbfgs.descend`, in at most `max_iter` cycles; returns no L-BFGS history."""

        def cycle(judge: ResidualEvaluator, now: ResidualState, force: np.ndarray) -> ResidualState:
            return judge(self._run_cycle(now.u, now.g, force))

        return run_cycles(self.problem, start, tolerance, max_iter, self.limits, cycle)

    def _run_cycle(self, u: wp.array, g: wp.array, force: np.ndarray) -> wp.array:
        """Run one cycle from residual g (3N, b) at u (3N, b); return the next state (3N, b).

        The near part is solved to a residual of `force` (b,) [N].
        """
        device, count = self.problem.device, u.shape[1]
        every = np.ones(count, bool)
        e = device.allocate(*u.shape)
        self.preconditioner.apply(g, every, e)
        self.problem.constraint.project_nodes(e)
        out = combine_columns(device, u, -1.0, e, e)
        near, aim = take_rows(device, u, self.rows), take_rows(device, out, self.rows)
        back, part = combine_columns(device, near, -1.0, aim, wp.empty_like(aim)), self.part.problem
        g = device.allocate(*near.shape)
        part.linearise(near, every)  # `definite`: the undeformed curvature
        part.add_curvature(back, g)
        self.part.set_force(None)
        load = part.gradient(near)
        self.part.set_force(combine_columns(device, load, -1.0, g, load))
        part.constraint.project_nodes(g)
        found = self.lbfgs.descend(
            near, np.zeros(count), self.size.max_iterations, None, force, self.size.straggler_fraction, (g, back)
        )
        missed = combine_columns(device, found.u, -1.0, aim, aim)
        followed = wp.empty_like(out)
        self.extend(take_rows(device, missed, self.shared_rows), followed)
        self.problem.constraint.project_nodes(followed)  # removes motion off the sliding planes by rounding
        combine_columns(device, out, 1.0, followed, out)
        put_rows(device, found.u, self.rows, out)
        return out


def has_small_opening(space: Discretisation, constraint: Constraint) -> bool:
    """Return True if the free surface is a small part of the whole surface, and not empty."""
    return 0 < len(list_open_vertices(space, constraint)) <= NEAR_PART.max_opening * len(np.unique(space.mesh.surface))


def find_near_tetrahedra(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """Mark (T,) bool the fraction `NearPart.fraction` of the tetrahedra that is nearest to the free surface."""
    mesh = space.mesh
    distance, _ = KDTree(mesh.nodes[list_open_vertices(space, constraint)]).query(mesh.nodes[mesh.tets].mean(axis=1))
    return distance <= np.quantile(distance, NEAR_PART.fraction)


def list_open_vertices(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """List the surface vertices (n,) that are neither fixed nor slide."""
    surface = np.unique(space.mesh.surface)
    return surface[~constraint.fixed[surface].any(axis=1) & ~constraint.normal[surface].any(axis=1)]


def build_batch_elimination(
    problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> BatchElimination | None:
    """Build the solver for the tissue near the opening; None if that part is too close to singular to be condensed.

    The preconditioner must be an exact inverse: multigrid would leave part of every correction to the next cycle.
    """
    device = problem.device
    chosen = find_near_tetrahedra(space, problem.constraint)
    nodes = np.unique(space.table[chosen])
    own = compile_part(effects, space, problem, chosen, nodes)
    try:
        around = condense_exterior(problem, nodes, own.rest_curvature())
        part = add_surrounding_stiffness(own, around.rows, around.stiffness)
        solver = build_rest_solver(part.problem)
    except RuntimeError:
        return None
    return BatchElimination(
        problem=problem,
        preconditioner=preconditioner,
        rows=device.upload((3 * nodes[:, None] + np.arange(3)).ravel(), wp.int32),
        part=part,
        lbfgs=Lbfgs(part.problem, solver),
        shared_rows=device.upload(around.rows, wp.int32),
        extend=build_product(around.extension, device, reduced=True),
    )

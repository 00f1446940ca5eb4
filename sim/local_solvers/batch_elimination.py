"""Nonlinear elimination: the most strained part is solved repeatedly as a local subproblem; the remaining mesh follows.

Near the tools, the stiffness of tissue differs strongly from the undeformed stiffness; elsewhere tissue is nearly
linear. A descent with the undeformed stiffness needs most of its iterations for the near part, at the cost of the whole
mesh. Here each cycle corrects the whole mesh by the undeformed stiffness, then solves the near part within the linear
far part, and moves the far part accordingly: Gendre, Allix, Gosselet, Comte 2009, "Non-intrusive and exact global/local
techniques for structural problems with local plasticity", Comput. Mech. 44:233-245. See `outer_loop.py` for the loop.

C is the inverse of the undeformed stiffness, r the gradient at u, and e = -C r the linear correction. The near part
solves n(u + x) - n(u) + F x = (n' + F) e for x. Here n are its internal forces, n' its undeformed stiffness, and F the
condensed stiffness of the far part. The far part moves by e + H (x - e), where H maps shared rows to the far part. If n
were linear, x would be e.
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
    """Size of the near part, and limits of its solution.

    Parameters
    ----------
    fraction, max_opening
        Fraction of the tetrahedra in the near part; largest fraction of surface vertices that may be free.
    max_iterations, straggler_fraction
        Maximum L-BFGS iterations in one cycle; a cycle ends early if at most this fraction of load cases is unfinished.
    """

    fraction: float = 0.2
    max_opening: float = 0.25
    max_iterations: int = 100
    straggler_fraction: float = 0.05


NEAR_PART = NearPart()  # Default.


@dataclass(frozen=True, eq=False)
class BatchElimination:
    """Solver for problems that are strongly nonlinear only in a small part.

    problem, preconditioner
        Problem of the whole mesh, and the inverse of its undeformed stiffness.
    rows
        Rows (3n,) of the near part among the 3N rows of the whole mesh, on the device.
    part, lbfgs
        Subproblem of the near part within the condensed far part, and its solver.
    shared_rows, extend_motion
        Rows (m,) that near and far part share, on the device; function that writes the motion of the far part to
        out (3N, b), from the motion x (m, b) of the shared rows.
    limits, size
        Limits of the cycles; size and limits of the near part.
    """

    problem: Problem
    preconditioner: Preconditioner
    rows: wp.array
    part: LocalProblem
    lbfgs: Lbfgs
    shared_rows: wp.array
    extend_motion: Callable[[wp.array, wp.array], None]
    limits: CycleLimits = DEFAULT_CYCLE_LIMITS
    size: NearPart = NEAR_PART

    def descend(
        self, start: wp.array, tolerance: np.ndarray, max_iter: int, warm_start: Mapping[str, np.ndarray] | None = None
    ) -> DescentResult:
        """Return the result as `Lbfgs.descend`, after at most `max_iter` cycles, without an L-BFGS history."""

        def run_cycle(evaluate: ResidualEvaluator, state: ResidualState, tolerance: np.ndarray) -> ResidualState:
            return evaluate(self._run_cycle(state.u, state.g, tolerance))

        return run_cycles(self.problem, start, tolerance, max_iter, self.limits, run_cycle)

    def _run_cycle(self, u: wp.array, g: wp.array, tolerance: np.ndarray) -> wp.array:
        """Return the next state (3N, b) after one cycle from u (3N, b) with the residual g (3N, b).

        The near part is solved until its residual is below `tolerance` (b,) [N].
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
            near, np.zeros(count), self.size.max_iterations, None, tolerance, self.size.straggler_fraction, (g, back)
        )
        missed = combine_columns(device, found.u, -1.0, aim, aim)
        followed = wp.empty_like(out)
        self.extend_motion(take_rows(device, missed, self.shared_rows), followed)
        self.problem.constraint.project_nodes(followed)  # removes motion off the sliding planes by rounding
        combine_columns(device, out, 1.0, followed, out)
        put_rows(device, found.u, self.rows, out)
        return out


def has_small_opening(space: Discretisation, constraint: Constraint) -> bool:
    """Return True if the free surface is a small, not empty part of the whole surface."""
    return 0 < len(list_open_vertices(space, constraint)) <= NEAR_PART.max_opening * len(np.unique(space.mesh.surface))


def find_near_tetrahedra(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """Return a mask (T,) of the tetrahedra nearest to the free surface, a fraction `NearPart.fraction` of all."""
    mesh = space.mesh
    distance, _ = KDTree(mesh.nodes[list_open_vertices(space, constraint)]).query(mesh.nodes[mesh.tets].mean(axis=1))
    return distance <= np.quantile(distance, NEAR_PART.fraction)


def list_open_vertices(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """Return the surface vertices (n,) that are neither fixed nor sliding."""
    surface = np.unique(space.mesh.surface)
    return surface[~constraint.fixed[surface].any(axis=1) & ~constraint.normal[surface].any(axis=1)]


def build_batch_elimination(
    problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> BatchElimination | None:
    """Return the solver for tissue near the craniotomy, or None if this part is too close to singular to be condensed.

    The preconditioner must be an exact inverse; with multigrid, each cycle would leave a part of its correction.
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
        extend_motion=build_product(around.extension, device, is_reduced=True),
    )

"""Nonlinear elimination: a part that is strained most is solved by itself, again and again, and the rest follows it.

Close to the tools tissue is far from its rest stiffness, elsewhere it is nearly linear. A descent from the rest
stiffness spends most of its iterations on the first, at the price of the whole body. Here each cycle corrects the whole
with the rest stiffness, then solves the near part in its surroundings, as stiff as at rest. The far part follows:
Gendre, Allix, Gosselet, Comte 2009, "Non-intrusive and exact global/local techniques for structural problems with local
plasticity", Comput. Mech. 44:233-245. The outer loop is that of nonlinear elimination (`outer_loop.py`).

C is the inverse of the rest stiffness, r the gradient at u, and e = -C r the linear correction. The near part finds x
of n(u + x) - n(u) + F x = (n' + F) e there. Here n are its internal forces, n' and F the stiffness of its own and that
of the far part, condensed, at rest. The far part takes e + H (x - e): H is how it follows the rows that both share.
Were n linear, x would be e.
"""

from __future__ import annotations

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
from ..minimisers.lbfgs import Descended, Lbfgs
from ..minimisers.residual import Judge, ResidualState
from ..runtime.columns import combine_columns, put_rows, take_rows
from ..runtime.dense_product import build_product
from .outer_loop import USUAL, CycleLimits, run_cycles


@dataclass(frozen=True)
class NearPart:
    """Which tissue is near the opening, and how long it is solved by itself.

    Parameters
    ----------
    share, largest_opening
        Of the tetrahedra, where the free surface is at most such a share of all of it.
    iterations, stragglers
        Most of L-BFGS in one cycle, which ends earlier where at most this share of the columns is left.
    """

    share: float = 0.2
    largest_opening: float = 0.25
    iterations: int = 100
    stragglers: float = 0.05


NEAR = NearPart()


@dataclass(frozen=True, eq=False)
class BatchElimination:
    """A descent for problems that are nonlinear in a small place.

    problem, preconditioner
        The whole body, and its inverse rest stiffness.
    rows
        (3n,) on the device: the near part's among the whole's 3N.
    part, lbfgs
        The near part in its surroundings, and the descent that solves it.
    shared, follow
        (m,) rows of the near part that the far part touches, on the device; (x (m, b), out (3N, b)): how it follows.
    limits, near
        When cycles end; how long the near part is solved.
    """

    problem: Problem
    preconditioner: Preconditioner
    rows: wp.array
    part: LocalProblem
    lbfgs: Lbfgs
    shared: wp.array
    follow: Callable[[wp.array, wp.array], None]
    limits: CycleLimits = USUAL
    near: NearPart = NEAR

    def descend(
        self, start: wp.array, tolerance: np.ndarray, most: int, learnt: Mapping[str, np.ndarray] | None = None
    ) -> Descended:
        """As `Lbfgs.descend`, in at most `most` cycles; nothing is learnt."""

        def cycle(judge: Judge, now: ResidualState, force: np.ndarray) -> ResidualState:
            return judge(self._corrected(now.u, now.g, force))

        return run_cycles(self.problem, start, tolerance, most, self.limits, cycle)

    def _corrected(self, u: wp.array, g: wp.array, force: np.ndarray) -> wp.array:
        """Return the next state (3N, b), from the free gradient g (3N, b) at u (3N, b).

        Force (b,) [N] may be left near.
        """
        device, count = self.problem.device, u.shape[1]
        every = np.ones(count, bool)
        e = device.zeros(*u.shape)
        self.preconditioner.apply(g, every, e)
        self.problem.constraint.project_nodes(e)
        out = combine_columns(device, u, -1.0, e, e)
        near, aim = take_rows(device, u, self.rows), take_rows(device, out, self.rows)
        back, part = combine_columns(device, near, -1.0, aim, wp.empty_like(aim)), self.part.problem
        g = device.zeros(*near.shape)
        part.linearise(near, every)  # at rest, as positive definite curvature is
        part.add_curvature(back, g)
        self.part.put(None)
        load = part.gradient(near)
        self.part.put(combine_columns(device, load, -1.0, g, load))
        part.constraint.project_nodes(g)
        found = self.lbfgs.descend(
            near, np.zeros(count), self.near.iterations, None, force, self.near.stragglers, (g, back)
        )
        missed = combine_columns(device, found.u, -1.0, aim, aim)
        followed = wp.empty_like(out)
        self.follow(take_rows(device, missed, self.shared), followed)
        self.problem.constraint.project_nodes(followed)  # what is rounded row by row leaves the planes it slides on
        combine_columns(device, out, 1.0, followed, out)
        put_rows(device, found.u, self.rows, out)
        return out


def has_small_opening(space: Discretisation, constraint: Constraint) -> bool:
    """Whether a part of the surface is free, and no large one."""
    return 0 < len(open_vertices(space, constraint)) <= NEAR.largest_opening * len(np.unique(space.mesh.surface))


def find_near_tetrahedra(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """(T,) bool: the share `NEAR.share` nearest to where the surface is free."""
    mesh = space.mesh
    distance, _ = KDTree(mesh.nodes[open_vertices(space, constraint)]).query(mesh.nodes[mesh.tets].mean(axis=1))
    return distance <= np.quantile(distance, NEAR.share)


def open_vertices(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """Vertices (n,) of the surface that neither are held nor slide."""
    surface = np.unique(space.mesh.surface)
    return surface[~constraint.held[surface].any(axis=1) & ~constraint.normal[surface].any(axis=1)]


def build_batch_elimination(
    problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> BatchElimination | None:
    """Of the tissue near the opening, which is small; None where that is too nearly singular to be taken apart.

    The preconditioner is an inverse: levels, which solve nearly, would leave a share of every correction to the next
    cycle.
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
        rows=device.array((3 * nodes[:, None] + np.arange(3)).ravel(), wp.int32),
        part=part,
        lbfgs=Lbfgs(part.problem, solver),
        shared=device.array(around.rows, wp.int32),
        follow=build_product(around.follow, device, rough=True),
    )

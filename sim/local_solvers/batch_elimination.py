"""Nonlinear elimination: a part that is strained most is solved by itself, again and again, and the rest follows it.

Close to the tools tissue is far from its rest stiffness, elsewhere it is nearly linear. A descent from the rest
stiffness spends most of its turns on the first, at the price of the whole body. Here each cycle corrects the whole with
the rest stiffness, then solves the near part in its surroundings, as stiff as at rest, and lets the far part follow:
Gendre, Allix, Gosselet, Comte 2009, "Non-intrusive and exact global/local techniques for structural problems with local
plasticity", Comput. Mech. 44:233-245; nonlinear elimination is that of Cai, Keyes 2002, "Nonlinearly preconditioned
inexact Newton algorithms", SIAM J. Sci. Comput. 24:183-200.

With C the inverse of the rest stiffness, r the gradient at u, and e = -C r the linear correction, the near part finds x
of n(u + x) - n(u) + F x = (n' + F) e there: n are its internal forces, n' and F the stiffness of its own and that of
the far part, condensed, at rest. The far part takes e + H (x - e): H is how it follows the rows that both share. Were n
linear, x would be e.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ..compile import Part, compile_part, surrounded
from ..discretisation.constraint import Constraint
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.pcg import Preconditioner
from ..linalg.preconditioner import rest_solver
from ..linalg.schur import condensed
from ..minimisers.lbfgs import Descended, Lbfgs
from ..minimisers.lbfgs_kernels import BROKEN, DONE, FREE, LIVE, WHOLE
from ..minimisers.residual import balance, constants_of
from ..runtime.columns import combined, gathered, put_rows, rows_taken, scattered
from ..runtime.dense_product import product_with

# The near part: such a share of the tetrahedra, where the free surface is at most such a share of all of it.
NEAR, LARGEST_OPENING = 0.2, 0.25
CYCLES = 20
# The near part is solved to a share of the whole residual, or of the tolerance, in so many turns or until few columns
# are left.
FORCING, ENOUGH, TURNS, STRAGGLERS = 0.03, 0.3, 100, 0.05
# A column whose free force was not halved in so many cycles goes elsewhere.
PATIENCE = 5
# Hard loads pass through states whose free force is so many times the start's; beyond that they have exploded.
RISE = 30.0


@dataclass(frozen=True, eq=False)
class Elimination:
    """A descent for problems that are nonlinear in a small place.

    problem, preconditioner
        The whole body, and its inverse rest stiffness.
    rows
        (3n,) on the device: the near part's among the whole's 3N.
    part, lbfgs
        The near part in its surroundings, and the descent that solves it.
    shared, follow
        (m,) rows of the near part that the far part touches, on the device; (x (m, b), out (3N, b)): how it follows.
    """

    problem: Problem
    preconditioner: Preconditioner
    rows: wp.array
    part: Part
    lbfgs: Lbfgs
    shared: wp.array
    follow: Callable[[wp.array, wp.array], None]

    def descend(
        self, start: wp.array, tolerance: np.ndarray, most: int, learnt: Mapping[str, np.ndarray] | None = None
    ) -> Descended:
        """As `Lbfgs.descend`, in at most `most` cycles; nothing is learnt.

        A column that has not got below the free force of its start ends there: it has not become better.
        """
        problem, device, count = self.problem, self.problem.device, start.shape[1]
        result, u, live = wp.clone(start), wp.clone(start), np.arange(count)
        status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
        first, mark, idle = np.full(count, np.inf), np.full(count, np.inf), np.zeros(count, int)
        constant, loud = constants_of(problem, u)
        square = loud.numpy().max(axis=0, initial=0.0)
        last = min(CYCLES, most)
        for cycle in range(last + 1):
            found = balance(problem, u, constant)
            sums, own = found.sums.numpy(), found.own.numpy()
            largest = np.maximum(square[live], own.max(axis=0))
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                free, largest = np.sqrt(sums[FREE]), np.sqrt(np.maximum(largest, sums[WHOLE] - sums[FREE]))
                relative = np.where(free == 0.0, 0.0, free / largest)
            finite = np.isfinite(relative) & np.isfinite(largest)
            if cycle == 0:
                first, status[~finite] = free, BROKEN
            sane, better = finite & (free <= RISE * first[live]), finite & (free <= first[live])
            residual[live[better]], steps[live[sane]] = relative[better], cycle
            done = better & (relative <= tolerance[live])  # forces that explode lower the relative residual
            status[live[done]] = DONE
            halved = free <= 0.5 * mark[live]
            mark[live[halved]] = free[halved]
            idle[live] = np.where(halved, 0, idle[live] + 1)
            leave = done | ~sane | (idle[live] >= PATIENCE) | (cycle == last)
            better &= leave
            scattered(device, gathered(device, u, np.flatnonzero(better)), live[better], result)
            if leave.all():
                break
            g, force = found.g, np.fmax(FORCING * free, ENOUGH * tolerance[live] * largest)
            if leave.any():
                stay = np.flatnonzero(~leave)
                problem.keep(stay)
                u, g, constant = (gathered(device, array, stay) for array in (u, g, constant))
                live, force = live[stay], force[stay]
            u = self._corrected(u, g, force)
        return Descended(result, status, steps, residual, {})

    def _corrected(self, u: wp.array, g: wp.array, force: np.ndarray) -> wp.array:
        """The next state (3N, b), from the free gradient g (3N, b) at u (3N, b); force (b,) [N] may be left near."""
        device, count = self.problem.device, u.shape[1]
        every = np.ones(count, bool)
        e = device.zeros(*u.shape)
        self.preconditioner.apply(g, every, e)
        self.problem.constraint.project_nodes(e)
        out = combined(device, u, -1.0, e, e)
        near, aim = rows_taken(device, u, self.rows), rows_taken(device, out, self.rows)
        back, part = combined(device, near, -1.0, aim, wp.empty_like(aim)), self.part.problem
        g = device.zeros(*near.shape)
        part.linearise(near, every)  # at rest, as positive definite curvature is
        part.add_curvature(back, g)
        self.part.put(None)
        load = part.gradient(near)
        self.part.put(combined(device, load, -1.0, g, load))
        part.constraint.project_nodes(g)
        found = self.lbfgs.descend(near, np.zeros(count), TURNS, None, force, STRAGGLERS, (g, back))
        missed = combined(device, found.u, -1.0, aim, aim)
        followed = wp.empty_like(out)
        self.follow(rows_taken(device, missed, self.shared), followed)
        self.problem.constraint.project_nodes(followed)  # what is rounded row by row leaves the planes it slides on
        combined(device, out, 1.0, followed, out)
        put_rows(device, found.u, self.rows, out)
        return out


def has_small_opening(space: Discretisation, constraint: Constraint) -> bool:
    """Whether a part of the surface is free, and no large one."""
    return 0 < len(_free(space, constraint)) <= LARGEST_OPENING * len(np.unique(space.mesh.surface))


def near_tetrahedra(space: Discretisation, constraint: Constraint, share: float = NEAR) -> np.ndarray:
    """(T,) bool: the share nearest to where the surface is free."""
    mesh = space.mesh
    distance, _ = KDTree(mesh.nodes[_free(space, constraint)]).query(mesh.nodes[mesh.tets].mean(axis=1))
    return distance <= np.quantile(distance, share)


def _free(space: Discretisation, constraint: Constraint) -> np.ndarray:
    """Vertices (n,) of the surface that neither are held nor slide."""
    surface = np.unique(space.mesh.surface)
    return surface[~constraint.held[surface].any(axis=1) & ~constraint.normal[surface].any(axis=1)]


def eliminating(
    problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> Elimination | None:
    """Of the tissue near the opening, which is small; None where that is too nearly singular to be taken apart.

    The preconditioner is an inverse: levels, which solve nearly, would leave a share of every correction to the next
    cycle.
    """
    device = problem.device
    chosen = near_tetrahedra(space, problem.constraint)
    nodes = np.unique(space.table[chosen])
    own = compile_part(effects, space, problem, chosen, nodes)
    try:
        around = condensed(problem, nodes, own.rest_curvature())
        part = surrounded(own, around.rows, around.stiffness)
        solver = rest_solver(part.problem)
    except RuntimeError:
        return None
    return Elimination(
        problem=problem,
        preconditioner=preconditioner,
        rows=device.array((3 * nodes[:, None] + np.arange(3)).ravel(), wp.int32),
        part=part,
        lbfgs=Lbfgs(part.problem, solver),
        shared=device.array(around.rows, wp.int32),
        follow=product_with(around.follow, device, rough=True),
    )

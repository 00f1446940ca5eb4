"""Local subproblem of some tetrahedra, whose nodes shared with other tetrahedra are fixed."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..accuracy import MIN_TOLERANCE, Accuracy
from ..compile import compile_clamped_part
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..linalg.multifrontal import SparseFactor, find_moved_nodes
from ..minimisers.lbfgs import Lbfgs
from ..minimisers.lbfgs_kernels import DONE, NOT_FINITE
from ..minimisers.newton import find_equilibrium
from ..minimisers.newton_cg import NewtonCG


@dataclass(frozen=True)
class PartLimits:
    """Iteration limits of a clamped part.

    Parameters
    ----------
    max_iterations, stale_iterations
        Maximum number of L-BFGS iterations before Newton's method; iterations after which the factor is recomputed.
    max_outer, max_inner
        Limits of Newton's method, as in `Accuracy`.
    """

    max_iterations: int = 400
    stale_iterations: int = 25
    max_outer: int = 60
    max_inner: int = 60


class ClampedPart:
    """Part of the mesh, clamped at its boundary, under one load case.

    Parameters
    ----------
    problem
        Problem of the whole mesh, which has begun with this load case only.
    effects, space
        Effects and discretisation from which the problem was compiled.
    tet_mask
        Mask (T,) of the tetrahedra of the part, at least one.
    constant_gradient
        Gradient (3N, 1) [N] of the loads, which does not depend on the displacements.
    u
        Approximate displacements (3N, 1) [m], at which the stiffness is factorised.
    limits
        Iteration limits.
    """

    def __init__(
        self,
        problem: Problem,
        effects: Iterable[Effect],
        space: Discretisation,
        tet_mask: np.ndarray,
        constant_gradient: wp.array,
        u: wp.array,
        limits: PartLimits = PartLimits(),
    ):
        self._limits = limits
        device, self.nodes = problem.device, np.unique(space.table[tet_mask])
        self._rows = (3 * self.nodes[:, None] + np.arange(3)).ravel()
        part = compile_clamped_part(effects, space, problem, tet_mask, self.nodes)
        self._part = part.problem
        part.set_force(device.upload(-constant_gradient.numpy()[self._rows]))
        values = u.numpy()[self._rows]
        if not (values.any() and self._try_tangent_stiffness(device.upload(values))):
            self._factorise_hessian(self._part.rest_curvature())

    def solve_part(self, u: wp.array, force_tolerance: float) -> wp.array:
        """Return u (3N, 1) with the part in equilibrium, up to a residual of about `force_tolerance` [N].

        If the forces in the part are not finite, u is returned unchanged.
        """
        part, device, values, limits = self._part, self._part.device, u.numpy().copy(), self._limits
        part.constraint.begin(values[self._rows], None, None)
        begun = device.upload(values[self._rows])
        found = self._lbfgs.descend(begun, np.zeros(1), limits.max_iterations, None, np.array([force_tolerance]))
        end = found.u
        if found.status[0] == NOT_FINITE:
            return u
        if found.status[0] != DONE:
            _, _, scale = part.residual(end)
            aim = float(np.clip(force_tolerance / scale[0], MIN_TOLERANCE[device.precision], 0.5))
            budget = Accuracy(aim, limits.max_outer, limits.max_inner, device.precision, 0)
            end = find_equilibrium(part, NewtonCG(self._factor, limits.max_inner), end, budget).u
        if found.steps[0] > limits.stale_iterations:
            self._try_tangent_stiffness(end)
        values[self._rows] = end.numpy()
        return device.upload(values)

    def _try_tangent_stiffness(self, u: wp.array) -> bool:
        """Set the initial Hessian of L-BFGS to the tangent stiffness at u (3n, 1); return False if it is indefinite."""
        try:
            self._factorise_hessian(self._part.assemble_stiffness(u))
        except RuntimeError:
            return False
        return True

    def _factorise_hessian(self, stiffness: sp.csc_array) -> None:
        """Set the initial Hessian of L-BFGS to a `stiffness` (3n, 3n) [N/m]."""
        basis = self._part.constraint.build_basis()
        self._factor = SparseFactor(stiffness, basis, find_moved_nodes(basis), self._part.device)
        self._lbfgs = Lbfgs(self._part, self._factor)

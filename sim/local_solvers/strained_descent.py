"""L-BFGS for single loads on the CPU; the initial stiffness includes the strain stiffening of tissue.

    (K0 + E D E')^-1 g = z - H E (1 + D C)^-1 D E' z,    z = H g,    H = K0^-1,  C = E' H E

Woodbury 1950, with D as in `strained_part.py`. With the undeformed stiffness, L-BFGS takes four times as many steps.
Strained tissue changes little between two frames, so the next descent begins with the same D.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial import KDTree

from ..arguments import is_all_finite
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..linalg.compliance import Compliance
from ..linalg.multifrontal import SparseFactor
from ..linalg.pcg import Preconditioner
from ..minimisers.lbfgs import DescentResult, Lbfgs
from ..runtime.threads import limit_to_one_thread
from .batch_elimination import list_open_vertices
from .strained_part import StrainedPart, StrainLimits

SINGLE_LIMITS = StrainLimits(min_strain=0.15, max_nodes=320, max_candidates=800)
"""Limits for a single model, which may use all memory and be incomplete: L-BFGS corrects the remainder."""


@dataclass(frozen=True)
class Renewal:
    """Limits after which a model is recomputed.

    Parameters
    ----------
    max_reused_steps
        Maximum number of steps of a descent whose model is reused in the next descent.
    max_evaluations
        Number of L-BFGS evaluations without convergence after which the model is recomputed at the current state.
    """

    max_reused_steps: int = 4
    max_evaluations: int = 8


@dataclass(frozen=True, eq=False)
class StiffnessUpdate:
    """Tangent stiffness of strained tissue minus its undeformed stiffness.

    `rows` (n,) of the 3N rows; `added` (n, n) is D [N/m]; `factor` (n, n) and `pivots` (n,) of 1 + D C are from LAPACK.
    Matrices are in single precision.
    """

    rows: np.ndarray
    added: np.ndarray
    factor: np.ndarray
    pivots: np.ndarray

    def compute_force(self, motion: np.ndarray) -> np.ndarray:
        """Return the correction forces (n,) [N] for a linear response `motion` (3N,) [m] of the undeformed mesh."""
        return -lu_solve((self.factor, self.pivots), self.added @ motion[self.rows], check_finite=False)

    @property
    def warm_start(self) -> dict[str, np.ndarray]:
        """Entries, by name, for the `warm` data of a solution."""
        return {name: getattr(self, field)[None] for field, name in UPDATE_KEYS.items()}


# Keys of warm-start data, by field of `StiffnessUpdate`.
UPDATE_KEYS = {field: f"stiffening's {field}" for field in ("rows", "added", "factor", "pivots")}


class StiffenedPreconditioner:
    """Preconditioner of single load cases: factor of the undeformed stiffness, with an update for strained tissue."""

    on_device = False

    def __init__(self, base: SparseFactor, problem: Problem):
        self._rest, self._problem = base, problem
        self.stiffening: StiffnessUpdate | None = None

    def prepare(self, problem: Problem, columns: int) -> None:
        """Do nothing, since factor and update do not depend on the state."""

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Apply the factor and the Woodbury correction; omit the correction if the result is no descent direction."""
        self._rest.apply(r, case_mask, out)
        if self.stiffening is None:
            return
        z = out.numpy()[:, 0].astype(np.float32)
        pull, more = wp.zeros_like(r), wp.zeros_like(r)
        with limit_to_one_thread():
            pull.numpy()[self.stiffening.rows, 0] = self.stiffening.compute_force(z)
        self._problem.constraint.project_nodes(pull)
        self._rest.apply(pull, case_mask, more)
        whole, g = out.numpy() + more.numpy(), r.numpy()
        if (g * whole).sum(dtype=np.float64) > 0.0:
            out.assign(whole)


class StrainedDescent:
    """Solver for single loads of one problem on the CPU.

    Parameters
    ----------
    problem, factor
        Problem of the whole mesh, and the factor of its undeformed stiffness.
    part
        Object that finds the strained tissue.
    renewal
        Limits after which a model is recomputed.
    """

    def __init__(self, problem: Problem, factor: SparseFactor, part: StrainedPart, renewal: Renewal = Renewal()):
        self._problem, self._part, self._renewal = problem, part, renewal
        self._preconditioner = StiffenedPreconditioner(factor, problem)
        self._lbfgs = Lbfgs(problem, self._preconditioner)

    def descend(
        self, start: wp.array, tolerance: np.ndarray, max_iter: int, warm_start: Mapping[str, np.ndarray] | None = None
    ) -> DescentResult:
        """Return the result as `Lbfgs.descend`, for one load case, from a model. The first call takes 0.5 s more."""
        self._part.prepare()
        u, left, steps = start, max_iter, 0
        self._preconditioner.stiffening = self.get_warm_start(warm_start) or self._build_stiffness_update(u)
        while True:
            some = min(left, self._renewal.max_evaluations)
            found = self._lbfgs.descend(u, tolerance, some)
            left, steps = left - some, steps + int(found.steps[0])
            if not len(found.unfinished_cases) or left <= 0:
                break
            u = found.u
            self._preconditioner.stiffening = self._build_stiffness_update(u)
        stiffening, self._preconditioner.stiffening = self._preconditioner.stiffening, None
        serves = warm_start is not None and steps <= self._renewal.max_reused_steps
        kept = stiffening.warm_start if stiffening and serves else {}
        return replace(found, steps=np.array([steps]), warm_start=kept)

    def _build_stiffness_update(self, u: wp.array) -> StiffnessUpdate | None:
        """Return the stiffness update at u (3N, 1) [m], or None if no tissue is strained."""
        found = self._part.find_stiffening(u, np.arange(1))
        if not found[0].shape[1]:
            return None
        compliance = self._part.compliance
        place = (3 * found[0][0][:, None] + np.arange(3)).ravel()
        added = found[1][0].astype(np.float32)
        with limit_to_one_thread():
            soft = compliance.columns.take(place, axis=0).take(place, axis=1).astype(np.float32)
            system = sp.csr_array(added) @ (0.5 * (soft + soft.T))
            system[np.diag_indices(len(place))] += 1.0
            if not np.isfinite(system).all():
                return None
            return StiffnessUpdate(compliance.rows[place], added, *lu_factor(system, True, check_finite=False))

    def get_warm_start(self, warm_start: Mapping[str, np.ndarray] | None) -> StiffnessUpdate | None:
        """Return the update of an earlier descent from warm-start data, or None if it does not fit this problem."""
        if warm_start is None or any(name not in warm_start for name in UPDATE_KEYS.values()):
            return None
        rows, added, factor, pivots = (np.asarray(warm_start[name]) for name in UPDATE_KEYS.values())
        size = rows.shape[-1]
        shapes = [array.shape for array in (rows, added, factor, pivots)]
        if shapes != [(1, size), (1, size, size), (1, size, size), (1, size)]:
            return None
        if any(array.dtype.kind != "i" or (array < 0).any() for array in (rows, pivots)):
            return None
        if (rows >= self._problem.rows).any() or (pivots >= size).any() or not np.diagonal(factor[0]).all():
            return None
        if any(array.dtype != np.float32 or not is_all_finite(array) for array in (added, factor)):
            return None
        return StiffnessUpdate(rows[0], added[0], factor[0], pivots[0])


def build_strained_part(
    problem: Problem, preconditioner: Preconditioner, space: Discretisation, limits: StrainLimits = SINGLE_LIMITS
) -> StrainedPart:
    """Return the object that finds strained tissue, for a mesh with a small craniotomy; models use near nodes."""
    distance, _ = KDTree(space.nodes[list_open_vertices(space, problem.constraint)]).query(space.nodes)
    near = np.sort(np.argsort(distance, kind="stable")[: limits.max_candidates])
    return StrainedPart(problem, Compliance(problem, preconditioner, near), 0, limits)

"""Smoothed-aggregation algebraic multigrid, for meshes whose stiffness is too large to factorise.

Vanek, Mandel, Brezina 1996, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic
problems", Computing 56:179-196. The coarse levels must represent rigid motions. PyAMG builds the levels once, on the
host (Bell, Olson, Schroder, Southworth 2023, J. Open Source Softw. 8:5495); `multigrid.py` implements the cycle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyamg
import scipy.sparse as sp

from ..runtime.device import Device
from .multigrid import CHEBYSHEV, Chebyshev, ReducedPreconditioner, TwoLevelCycle, fill_diagonal
from .pcg import Preconditioner

Direct = Callable[[sp.csc_array, sp.csc_array, np.ndarray], Preconditioner]
"""Function (K, L, node (m,)) that builds a solver of K over motions L (n, m), as `multifrontal.SparseFactor`."""
# No strength threshold. Energy-minimising smoothing draws no random numbers: the same mesh gives the same levels.
AMG_SETTINGS: dict[str, Any] = {
    "strength": ("symmetric", {"theta": 0.0}),
    "smooth": ("energy", {"krylov": "cg", "maxiter": 2, "degree": 1}),
    "improve_candidates": None,
    "presmoother": None,
    "postsmoother": None,
    "coarse_solver": "splu",
}


def build_multigrid_cycle(
    stiffness: sp.bsr_array,
    rigid_motions: np.ndarray,
    build_direct: Direct,
    device: Device,
    max_coarsest: int = 1_000,
    smoother: Chebyshev = CHEBYSHEV,
) -> Preconditioner:
    """Return one V-cycle for a positive definite `stiffness` (3N, 3N) [N/m] with `rigid_motions` (3N, 6).

    The coarsest level has at most `max_coarsest` nodes, with six unknowns each.

    Raises
    ------
    RuntimeError
        The stiffness is singular on the coarsest level.
    """
    *fine, _ = pyamg.smoothed_aggregation_solver(
        sp.bsr_matrix(stiffness), B=rigid_motions, max_coarse=max_coarsest, **AMG_SETTINGS
    ).levels
    if not fine:
        return _build_direct_solver(
            sp.csc_array(stiffness), sp.csc_array(sp.eye_array(len(rigid_motions))), 3, build_direct
        )
    *upper, lowest = fine
    coarse = _build_direct_solver(sp.csc_array(lowest.A), sp.csc_array(lowest.P), lowest.P.blocksize[1], build_direct)
    solver = TwoLevelCycle(coarse, _to_bsr(lowest.A), device, smoother=smoother)
    for level in reversed(upper):
        solver = TwoLevelCycle(
            ReducedPreconditioner(sp.bsr_array(level.P), solver, device), _to_bsr(level.A), device, smoother=smoother
        )
    solver.name = f"algebraic multigrid, {len(fine) + 1} levels"
    return solver


def _build_direct_solver(stiffness: sp.csc_array, motions: sp.csc_array, size: int, solver: Direct) -> Preconditioner:
    """Return a direct solver over the motions, `size` per node; zero motions of small aggregates are omitted."""
    moving = np.flatnonzero(abs(motions).sum(axis=0) > 0.0)
    return solver(stiffness, motions[:, moving], moving // size)


def _to_bsr(matrix: sp.bsr_matrix) -> sp.bsr_array:
    return fill_diagonal(sp.csr_array(matrix), matrix.blocksize[0])


def build_rigid_motions(points: np.ndarray) -> np.ndarray:
    """Return translations and rotations (3N, 6) of points (N, 3), lengths relative to the extent of the points."""
    arm = points - points.mean(axis=0)
    arm /= np.abs(arm).max()
    turns = [np.cross(axis, arm) for axis in np.eye(3)]
    moves = [np.broadcast_to(axis, arm.shape) for axis in np.eye(3)]
    return np.stack([*moves, *turns], axis=-1).reshape(-1, 6)

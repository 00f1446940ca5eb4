"""Choice of the preconditioner of a problem, by size, element type and device."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp

from ..accuracy import Precision
from ..discretisation.constraint import Constraint
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..errors import InputError
from ..runtime.device import Device
from .multifrontal import SparseFactor, find_moved_nodes
from .multigrid import CHEBYSHEV, Chebyshev, ReducedPreconditioner, TwoLevelCycle, project_to_free
from .pcg import BlockJacobi, Preconditioner


@dataclass(frozen=True)
class Preconditioning:
    """Sizes up to which each type of preconditioner is fastest, and settings of multigrid.

    Parameters
    ----------
    max_factorised
        Number of unknowns above which multigrid is faster than a factor on the CPU. For 17,000 nodes, multigrid and
        factor take: set-up 6.8 and 7.1 s; application 16 and 11 ms for one load case, 51 and 83 ms for eight. On CUDA,
        all matrices that fit are inverted.
    max_smoothed_factorised
        Same limit for smoothed and element-free strains, whose factors have more entries, since they couple neighbours
        of neighbours.
    max_coarsest_nodes
        Maximum number of nodes, with six unknowns each, on the coarsest level of algebraic multigrid.
    smoother
        Smoother of all levels.
    """

    max_factorised: int = 50_000
    max_smoothed_factorised: int = 40_000
    max_coarsest_nodes: int = 1_000
    smoother: Chebyshev = CHEBYSHEV


def choose_preconditioner(
    problem: Problem,
    space: Discretisation,
    assemble_linear: Callable[[float], sp.csc_array],
    time_step: float = math.inf,
    settings: Preconditioning = Preconditioning(),
) -> Preconditioner:
    """Return the preconditioner: the undeformed stiffness, inverted (CUDA) or factorised if this is fast enough.

    If the stiffness has too many entries, a two-level cycle is used; if the coarse level is too large, algebraic
    multigrid; if no node is free, block Jacobi. `assemble_linear` assembles the undeformed stiffness (3V, 3V) [N/m] of
    linear tetrahedra on the same mesh for a time step [s]; `time_step` is the time step of the stiffness.

    Raises
    ------
    InputError
        The free undeformed stiffness is singular, or the device has too little memory.
    """
    device, constraint = problem.device, problem.constraint
    if constraint.build_basis().nnz == 0:
        return BlockJacobi(device)
    try:
        if space.element == "p2":
            stiffness = problem.rest_curvature(time_step)
            if device.on_cuda and _can_invert(len(constraint.build_basis().indptr) - 1, device):
                return _build_solver(stiffness, constraint, space.nodes, device, settings)
            lifted = _build_corner_preconditioner(stiffness, space, constraint, device, settings)
            name = f"p-multigrid on {get_preconditioner_name(lifted.coarse)}"
            return TwoLevelCycle(lifted, project_to_free(stiffness, constraint), device, name, settings.smoother)
        if space.element in ("smoothed", "element-free") and problem.rows > settings.max_smoothed_factorised:
            # Averaging reduces the stiffness, so that the coarse solver never overshoots. Element-free, it overshoots
            # at nu >= 0.49; the cycle was positive definite up to 0.499.
            coarse = _build_solver(assemble_linear(time_step), constraint, space.nodes, device, settings)
            name = f"two levels on {get_preconditioner_name(coarse)}"
            fine = project_to_free(problem.rest_curvature(time_step), constraint)
            return TwoLevelCycle(coarse, fine, device, name, settings.smoother)
        return _build_solver(problem.rest_curvature(time_step), constraint, space.nodes, device, settings)
    except RuntimeError as error:
        raise InputError(explain_factor_failure(error, device.name)) from error


def explain_factor_failure(error: RuntimeError, device: str) -> str:
    """Return the reason why the factorisation failed: too little memory, or a mesh that is not fixed."""
    if "allocate" in str(error):
        return f"{device} has too little free memory for this mesh: end what else runs there, or choose --device cpu."
    return f"the undeformed stiffness cannot be factorised ({error}): fix or support every part."


def get_preconditioner_name(preconditioner: Preconditioner) -> str:
    """Return the name of a preconditioner for messages."""
    match preconditioner:
        case TwoLevelCycle():
            return preconditioner.name
        case SparseFactor():
            return "sparse factor"
        case BlockJacobi():
            return "block Jacobi"
        case _:
            return "dense inverse"


def is_exact(preconditioner: Preconditioner) -> bool:
    """Return True if a preconditioner is the inverse of the whole undeformed stiffness, up to round-off."""
    return get_preconditioner_name(preconditioner) in ("sparse factor", "dense inverse")


def build_rest_solver(problem: Problem) -> Preconditioner:
    """Return the inverse or the factor of the free undeformed stiffness, in the precision of the problem.

    Raises
    ------
    RuntimeError
        The stiffness is singular.
    """
    basis = problem.constraint.build_basis()
    device = problem.device
    return build_direct_solver(problem.rest_curvature(), basis, find_moved_nodes(basis), device, device.precision)


def _build_corner_preconditioner(
    stiffness: sp.csc_array, space: Discretisation, constraint: Constraint, device: Device, settings: Preconditioning
) -> ReducedPreconditioner:
    """Return the coarse preconditioner: linear tetrahedra on the free corner nodes of the same mesh."""
    corner, free = np.unique(space.table[:, :4]), constraint.build_basis()
    every = sp.csc_array(free @ (free.T @ sp.kron(space.corner_interpolation, sp.eye_array(3))))
    own = Constraint(constraint.fixed[corner], constraint.normal[corner], device)
    coarse = _build_solver(sp.csc_array(every.T @ stiffness @ every), own, space.nodes[corner], device, settings)
    return ReducedPreconditioner(sp.bsr_array(sp.csr_array(every), blocksize=(3, 3)), coarse, device)


def _build_solver(
    stiffness: sp.csc_array, constraint: Constraint, points: np.ndarray, device: Device, settings: Preconditioning
) -> Preconditioner:
    """Return a solver of K (3N, 3N) for the free nodes at points (N, 3): direct if fast enough, else multigrid."""
    basis = constraint.build_basis()
    count = len(basis.indptr) - 1
    if _can_invert(count, device) if device.on_cuda else count <= settings.max_factorised:
        return build_direct_solver(stiffness, basis, find_moved_nodes(basis), device)
    from .amg import build_multigrid_cycle, build_rigid_motions

    motions = basis @ (basis.T @ build_rigid_motions(points))
    blocks, coarse = project_to_free(stiffness, constraint), partial(build_direct_solver, device=device)
    return build_multigrid_cycle(blocks, motions, coarse, device, settings.max_coarsest_nodes, settings.smoother)


def _can_invert(count: int, device: Device) -> bool:
    """Return True if the device is a GPU that can invert `count` unknowns."""
    from .dense_inverse import can_invert

    return can_invert(count, device)


def build_direct_solver(
    stiffness: sp.csc_array, motions: sp.csc_array, node: np.ndarray, device: Device, precision: Precision = "float32"
) -> Preconditioner:
    """Return a direct solver, an inverse if it fits or a factor, of K (3N, 3N) over motions (3N, n) of the nodes (n,).

    A factor is stored in `precision`.

    Raises
    ------
    RuntimeError
        K is singular.
    """
    if device.on_cuda and _can_invert(len(node), device):
        from .dense_inverse import DenseInverse

        return DenseInverse(stiffness, motions, device)
    return SparseFactor(stiffness, motions, node, device, precision)

"""Which preconditioner serves a problem: chosen by its size, its element and its device."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from .constraint import Constraint
from .device import Device
from .discretisation import Discretisation
from .errors import InputError
from .factor import Factor, node_of
from .linear import BlockJacobi, Preconditioner
from .multigrid import TwoLevel
from .problem import Problem

# Above this many unknowns the factor's memory and time outgrow what it saves.
LARGEST_FACTOR = 400_000
# Smoothed strains link the neighbours of neighbours: their own factor pays up to this many unknowns.
LARGEST_SMOOTHED_FACTOR = 40_000


def choose_preconditioner(
    problem: Problem, space: Discretisation, unsmoothed: Callable[[], sp.csc_array]
) -> Preconditioner:
    """The rest stiffness, inverted (CUDA) or factorised where that pays; two levels where it has too many entries.

    Block Jacobi where even the coarse level does not fit, or nothing is free to move. `unsmoothed` assembles the rest
    stiffness (3V, 3V) [N/m] of linear tetrahedra on the same mesh.

    Raises
    ------
    InputError
        A free rest stiffness that is singular.
    """
    device, constraint = problem.device, problem.constraint
    nothing_free = constraint.basis().nnz == 0
    if nothing_free or 3 * len(np.unique(space.table[:, :4])) > LARGEST_FACTOR:
        return BlockJacobi(device)
    try:
        if space.element == "p2":
            stiffness, (motions, node) = problem.rest_curvature(), _coarse_motions(space, constraint)
            return TwoLevel(_solver(stiffness, motions, node, device), stiffness, constraint, device)
        if space.element == "smoothed" and problem.rows > LARGEST_SMOOTHED_FACTOR:
            # An average resists less than what is averaged, so that the coarse solver never overshoots.
            basis = constraint.basis()
            coarse = _solver(unsmoothed(), basis, node_of(basis), device)
            return TwoLevel(coarse, problem.rest_curvature(), constraint, device)
        return rest_solver(problem)
    except RuntimeError as error:
        raise InputError(f"the stiffness at rest cannot be factorised ({error}): is every part held?") from error


def rest_solver(problem: Problem) -> Preconditioner:
    """The whole free rest stiffness, inverted or factorised.

    Raises
    ------
    RuntimeError
        It is singular.
    """
    basis = problem.constraint.basis()
    return _solver(problem.rest_curvature(), basis, node_of(basis), problem.device)


def _solver(stiffness: sp.csc_array, motions: sp.csc_array, node: np.ndarray, device: Device) -> Preconditioner:
    if device.on_cuda:
        from .dense import Dense, fits

        if fits(len(node), device):
            return Dense(stiffness, motions, device)
    return Factor(stiffness, motions, node, device)


def _coarse_motions(space: Discretisation, constraint: Constraint) -> tuple[sp.csc_array, np.ndarray]:
    """What linear tetrahedra on the same corners can do (3N, n), as far as it is free, and the corner (n,) of each."""
    every = space.corner_interpolation
    corner = np.unique(space.table[:, :4])
    basis = Constraint(constraint.held[corner], constraint.normal[corner], constraint.device).basis()
    free = constraint.basis()
    return sp.csc_array(free @ (free.T @ (sp.kron(every, sp.eye_array(3)) @ basis))), node_of(basis)

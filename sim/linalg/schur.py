"""Static condensation: stiffness of the undeformed exterior of a mesh part, and the motion of this exterior.

Guyan 1965, "Reduction of stiffness and mass matrices", AIAA J. 3:380.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.problem import Problem
from ..runtime.device import Device
from .multifrontal import find_moved_nodes
from .preconditioner import build_direct_solver


@dataclass(frozen=True)
class Condensing:
    """Settings of the static condensation.

    Parameters
    ----------
    round_off
        Entries up to this fraction of the largest entry are round-off of a subtraction and are set to zero.
    strip_size
        Number of columns solved together, which limits memory.
    """

    round_off: float = 1e-9
    strip_size: int = 256


@dataclass(frozen=True, eq=False)
class Condensation:
    """Exterior of a mesh part, condensed to the rows that the part and the exterior share.

    `rows` (m,) are the shared rows, among the 3n rows of the part. `stiffness` (m, m) [N/m] is the condensed stiffness
    of the exterior. `extension` (3N, m) maps motions of the shared rows to the whole mesh; it is zero inside the part.
    """

    rows: np.ndarray
    stiffness: np.ndarray
    extension: np.ndarray


def condense_exterior(
    problem: Problem, nodes: np.ndarray, part_stiffness: sp.csc_array, settings: Condensing = Condensing()
) -> Condensation:
    """Return the condensed exterior of the part with `nodes` (n,) and undeformed stiffness (3n, 3n) [N/m].

    Raises
    ------
    RuntimeError
        The exterior is not fixed even if the part is fixed.
    """
    part = (3 * nodes[:, None] + np.arange(3)).ravel()
    whole, basis = sp.csr_array(problem.rest_curvature()), problem.constraint.build_basis()
    beyond = sp.csr_array(whole[part][:, part] - part_stiffness)
    rows = np.flatnonzero(abs(beyond).max(axis=1).toarray().ravel() > settings.round_off * abs(whole).max())
    stiffness = beyond[rows][:, rows].toarray()
    far = sp.csc_array(basis[:, ~np.isin(find_moved_nodes(basis), nodes)])
    across = sp.csc_array(whole[part[rows]].T)
    follow, taken = _compute_reduction(whole, far, across, problem.device, settings.strip_size)
    stiffness -= taken
    return Condensation(rows, (stiffness + stiffness.T) / 2, follow)


def _compute_reduction(
    stiffness: sp.csr_array, motions: sp.csc_array, coupling: sp.csc_array, device: Device, strip_size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return -L (L^T K L)^-1 L^T B (3N, m) and the Schur reduction (m, m), for motions L and a coupling B (3N, m).

    On CUDA, unknowns are eliminated in blocks if the memory suffices.
    """
    if device.on_cuda:
        from . import block_inverse

        where = wp.device_to_torch(device.name)
        if block_inverse.can_invert(len(motions.indptr) + len(coupling.indptr), where):
            across, taken = block_inverse.eliminate_unknowns(
                sp.csc_array(motions.T @ stiffness @ motions), sp.csc_array(motions.T @ coupling), where
            )
            return -(motions.astype(np.float32) @ across), taken
    fine = Device(device.name, "float64")
    solver = build_direct_solver(sp.csc_array(stiffness), motions, find_moved_nodes(motions), fine, "float64")
    count = len(coupling.indptr) - 1
    follow, taken = np.zeros((len(stiffness.indptr) - 1, count), device.precision), np.zeros((count, count))
    for first in range(0, count, strip_size):
        some = coupling[:, first : first + strip_size].toarray()
        out = fine.allocate(*some.shape)
        solver.apply(fine.upload(some), np.ones(some.shape[1], bool), out)
        moved = out.numpy()
        follow[:, first : first + strip_size] = -moved
        taken[:, first : first + strip_size] = coupling.T @ moved
    return follow, taken

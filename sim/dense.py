"""CUDA's preconditioner for meshes of a few thousand nodes: the inverse rest stiffness as one dense matrix.

One matrix product serves a whole batch of load cases, where triangular solves would leave the card idle. The only file
of this room that uses torch, for its matrix product; it is imported by its arm in `fem` alone.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp

from .device import Device
from .problem import Problem
from .sparse import Sparse

# Stiffness, factor, inverse and what the factorisation works in stand in memory together, in double precision.
COPIES = 5


def fits(rows: int, device: Device) -> bool:
    """Whether torch sees the card, and the dense matrices of `rows` unknowns fit into its free memory."""
    if not torch.cuda.is_available():
        return False
    free, _ = torch.cuda.mem_get_info(wp.device_to_torch(device.name))
    return COPIES * 8 * rows**2 < free


class Dense:
    """A rest stiffness K over some motions L, L (L^T K L)^-1 L^T, inverted in double precision, kept in the solver's.

    stiffness K (3N, 3N) [N/m]; motions L (3N, n), independent columns.

    Raises
    ------
    RuntimeError
        K is not positive definite over these motions: something is not held.
    """

    def __init__(self, stiffness: sp.csc_array, motions: sp.csc_array, device: Device):
        self._device = device
        where = wp.device_to_torch(device.name)
        precision = getattr(torch, device.precision)
        entry = sp.coo_array(motions.T @ stiffness @ motions)
        place = tuple(torch.as_tensor(index, dtype=torch.int64, device=where) for index in (entry.row, entry.col))
        count = len(motions.indptr) - 1
        free = torch.zeros((count, count), dtype=torch.float64, device=where)
        free.index_put_(place, torch.as_tensor(entry.data, device=where))
        self._inverse = torch.cholesky_inverse(torch.linalg.cholesky(free)).to(precision)
        self._motions, self._transposed = (Sparse(sp.csr_array(matrix), device) for matrix in (motions, motions.T))
        torch.cuda.synchronize(where)

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """One dense matrix product, in Warp's stream."""
        restricted = self._transposed.times(r)
        solved = self._device.zeros(*restricted.shape)
        with torch.cuda.stream(wp.stream_to_torch(self._device.name)):
            torch.matmul(self._inverse, wp.to_torch(restricted), out=wp.to_torch(solved))
        wp.copy(out, self._motions.times(solved))

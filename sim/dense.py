"""CUDA's preconditioner for meshes of a few thousand nodes: the inverse rest stiffness as one dense matrix.

One matrix product serves a whole batch of load cases, where triangular solves would leave the card idle. The only file
of this room that uses torch, for its matrix product; it is imported by its arm in `fem` alone.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp

from .constraint import Constraint
from .device import Device
from .problem import Problem

# Stiffness, factor, basis, inverse and a product stand in memory together, in double precision.
COPIES = 6


def fits(rows: int, device: Device) -> bool:
    """Whether torch sees the card, and the dense matrices of `rows` = 3N unknowns fit into its free memory."""
    if not torch.cuda.is_available():
        return False
    free, _ = torch.cuda.mem_get_info(wp.device_to_torch(device.name))
    return COPIES * 8 * rows**2 < free


class Dense:
    """The free rest stiffness, inverted in double precision and kept in the solver's.

    Raises
    ------
    RuntimeError
        The free stiffness is not positive definite: something is not held.
    """

    def __init__(self, stiffness: sp.csc_array, constraint: Constraint, device: Device):
        self._device = device
        where = wp.device_to_torch(device.name)
        basis = constraint.basis()
        free = torch.as_tensor((basis.T @ stiffness @ basis).toarray(), device=where)
        span = torch.as_tensor(basis.toarray(), device=where)
        inverse = span @ torch.cholesky_inverse(torch.linalg.cholesky(free)) @ span.T
        self._inverse = inverse.to(getattr(torch, device.precision))
        torch.cuda.synchronize(where)

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """One matrix product, in Warp's stream."""
        with torch.cuda.stream(wp.stream_to_torch(self._device.name)):
            torch.matmul(self._inverse, wp.to_torch(r), out=wp.to_torch(out))

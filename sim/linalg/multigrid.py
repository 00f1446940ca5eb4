"""Multigrid: Chebyshev smoothing on the undeformed stiffness, and a coarse solver for slowly varying errors.

For quadratic tetrahedra, the coarse level is linear tetrahedra with the same corners (p-multigrid): Sundar, Stadler,
Biros 2015, "Comparison of multigrid algorithms for high-order continuous finite element discretizations", Numer. Linear
Algebra Appl. 22:664-680. The smoother is a Chebyshev polynomial of block Jacobi: Adams et al. 2003, J. Comput. Phys.
188:593-610. The coarse solver may itself have several levels (`sim/linalg/amg.py`).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.constraint import Constraint
from ..discretisation.problem import Problem
from ..runtime.columns import combine_columns, compute_dots, gather_columns, scatter_columns
from ..runtime.device import Device, forward_kernel
from .block_sparse import BlockSparse
from .pcg import Preconditioner


@dataclass(frozen=True)
class Chebyshev:
    """Chebyshev smoother of a level.

    Parameters
    ----------
    degree
        Degree of the polynomial: number of stiffness products before, and again after, the coarse solver.
    min_damped
        Smallest damped eigenvalue, relative to the largest; the coarse solver reduces errors of smaller eigenvalues.
    power_iterations
        Number of iterations that estimate the largest eigenvalue, once.
    safety_factor
        Factor by which the estimate is increased, since it is a lower bound.
    """

    degree: int = 3
    min_damped: float = 1.0 / 8.0
    power_iterations: int = 20
    safety_factor: float = 1.1


CHEBYSHEV = Chebyshev()
"""Default smoother of every level."""


@cache
def build_kernel(device: Device, size: int) -> wp.Kernel:
    """Return the kernel of the block-diagonal step, with blocks (size, size)."""
    scalar = device.scalar
    mat, vec = wp.types.matrix((size, size), scalar), wp.types.vector(size, scalar)

    @forward_kernel(module="unique")
    def apply_step(
        inverse: wp.array(dtype=mat),
        momentum: scalar,
        scale: scalar,
        r: wp.array2d(dtype=scalar),
        # outputs
        d: wp.array2d(dtype=scalar),
        x: wp.array2d(dtype=scalar),
    ):
        """Compute d_i = kept d_i + added D_i^-1 r_i, and add d_i to x_i."""
        i, c = wp.tid()
        part = vec()
        for k in range(size):
            part[k] = r[size * i + k, c]
        z = inverse[i] * part
        for k in range(size):
            new = momentum * d[size * i + k, c] + scale * z[k]
            d[size * i + k, c] = new
            x[size * i + k, c] += new

    return apply_step


class TwoLevelCycle:
    """Symmetric two-level cycle: smoothing, correction by the coarse solver, smoothing.

    Parameters
    ----------
    coarse
        Operator L A^-1 L^T for motions L, where A is at least L^T K L.
    stiffness
        Positive definite undeformed stiffness K (n, n) [N/m] in square blocks.
    device
        Device of the arrays.
    name
        Name for messages.
    smoother
        Smoother of this level.
    """

    on_device = False  # a cycle allocates arrays, which a captured graph cannot replay

    def __init__(
        self,
        coarse: Preconditioner,
        stiffness: sp.bsr_array,
        device: Device,
        name: str = "two levels",
        smoother: Chebyshev = CHEBYSHEV,
    ):
        self.name, self._smoother = name, smoother
        self._coarse, self._device = coarse, device
        self._stiffness = BlockSparse(stiffness, device)
        self._size = stiffness.blocksize[0]
        inverse = np.linalg.inv(_extract_diagonal(stiffness))
        self._inverse = device.upload(inverse, wp.types.matrix((self._size, self._size), device.scalar))
        self._largest = smoother.safety_factor * self._estimate_eigenvalue()

    def prepare(self, problem: Problem, columns: int) -> None:
        """Do nothing: the undeformed stiffness is used at every state."""

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Compute `out` from `r` by one cycle, for the live load cases."""
        if case_mask.all():
            wp.copy(out, self._run_cycle(r))
            return
        columns = np.flatnonzero(case_mask)
        scatter_columns(self._device, self._run_cycle(gather_columns(self._device, r, columns)), columns, out)

    def _run_cycle(self, r: wp.array) -> wp.array:
        x, correction = self._device.allocate(*r.shape), self._device.allocate(*r.shape)
        every = np.ones(r.shape[1], bool)
        self._smooth(x, wp.clone(r))
        self._coarse.apply(self._compute_residual(r, x), every, correction)
        combine_columns(self._device, x, np.ones(x.shape[1]), correction, x)
        self._smooth(x, self._compute_residual(r, x))
        return x

    def _smooth(self, x: wp.array, r: wp.array) -> None:
        """Add the smoothing polynomial of the residual r to x, and overwrite r; Saad 2003, algorithm 12.1."""
        low = self._smoother.min_damped * self._largest
        centre, radius = (self._largest + low) / 2.0, (self._largest - low) / 2.0
        ratio = radius / centre
        d = self._device.allocate(*r.shape)
        self._apply_step(0.0, 1.0 / centre, r, d, x)
        for _ in range(self._smoother.degree - 1):
            self._stiffness.add_product(r, -1.0, d)
            following = 1.0 / (2.0 * centre / radius - ratio)
            self._apply_step(following * ratio, 2.0 * following / radius, r, d, x)
            ratio = following

    def _compute_residual(self, r: wp.array, x: wp.array) -> wp.array:
        out = wp.clone(r)
        self._stiffness.add_product(out, -1.0, x)
        return out

    def _apply_step(self, momentum: float, scale: float, r: wp.array, d: wp.array, x: wp.array) -> None:
        scalar, step = self._device.scalar, build_kernel(self._device, self._size)
        inputs = [self._inverse, scalar(momentum), scalar(scale), r]
        self._device.launch(step, (r.shape[0] // self._size, r.shape[1]), inputs, [d, x])

    def _estimate_eigenvalue(self) -> float:
        """Return the largest eigenvalue of D^-1 K, estimated by power iteration."""
        device = self._device
        x = device.upload(np.random.default_rng(0).normal(size=(self._stiffness.rows, 1)))
        largest = 1.0
        for _ in range(self._smoother.power_iterations):
            new, sum_ = device.allocate(*x.shape), device.allocate(*x.shape)
            self._apply_step(0.0, 1.0, self._stiffness.multiply(x), new, sum_)
            size = float(np.sqrt(compute_dots(device, new, new)[0]))
            largest = float(compute_dots(device, x, new)[0] / compute_dots(device, x, x)[0])
            x = combine_columns(device, device.allocate(*x.shape), np.array([1.0 / size]), new, x)
        return largest


class ReducedPreconditioner:
    """Preconditioner L M L^T: a preconditioner M with fewer unknowns, prolonged by motions L (m, n) in blocks."""

    on_device = False

    def __init__(self, motions: sp.bsr_array, coarse: Preconditioner, device: Device):
        self.coarse, self._device = coarse, device
        self._up, self._down = BlockSparse(motions, device), BlockSparse(sp.bsr_array(motions.T), device)

    def prepare(self, problem: Problem, columns: int) -> None:
        """Do nothing: the undeformed stiffness is used at every state."""

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Compute out = L M L^T r: restrict r, apply the coarse preconditioner, and prolong the result."""
        right = self._down.multiply(r)
        solved = self._device.allocate(*right.shape)
        self.coarse.apply(right, case_mask, solved)
        wp.copy(out, self._up.multiply(solved))


def project_to_free(stiffness: sp.csc_array, constraint: Constraint) -> sp.bsr_array:
    """Return P K P (3N, 3N) in node blocks, with P the projection to free unknowns; fixed unknowns are regularised."""
    basis = constraint.build_basis()
    projection = sp.csr_array(basis @ basis.T)
    blocked = sp.eye_array(constraint.fixed.size) - projection
    return fill_diagonal(sp.csr_array(projection @ stiffness @ projection + stiffness.diagonal().mean() * blocked), 3)


def fill_diagonal(matrix: sp.csr_array, size: int) -> sp.bsr_array:
    """Return a matrix in blocks (size, size); zero diagonal entries, of unknowns without elements, become the mean."""
    diagonal = matrix.diagonal()
    missing = np.where(diagonal == 0.0, diagonal.mean(), 0.0)
    return sp.bsr_array(sp.csr_array(matrix + sp.diags_array(missing)), blocksize=(size, size))


def _extract_diagonal(blocks: sp.bsr_array) -> np.ndarray:
    """Return the diagonal blocks (N, k, k)."""
    row = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
    return blocks.data[row == blocks.indices]

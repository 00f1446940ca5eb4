"""Preconditioned conjugate gradients for a batch of load cases, and the interface of preconditioners.

Steihaug 1983, "The conjugate gradient method and trust regions in large scale optimization", SIAM J. Numer. Anal.
20:626-637. The iteration stops at negative curvature, or at the boundary of a ball in the norm of the preconditioner.
The result is a descent direction; a shorter result is closer to the direction of the preconditioned gradient.
"""

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..runtime.columns import combine_columns, compute_dots, compute_norms
from ..runtime.device import Device, forward_kernel


class Preconditioner(Protocol):
    """Interface of preconditioners: symmetric positive definite approximations of the inverse of the free stiffness."""

    @property
    def on_device(self) -> bool:
        """True if `apply` only launches kernels on the device, with the same arrays for all batches of one width.

        A GPU can then replay `apply` as part of a captured graph, for any `live`.
        """
        ...

    def prepare(self, problem: Problem, columns: int) -> None:
        """Prepare `apply` for the last linearisation, if needed; `columns` is the width of the batch."""
        ...

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Compute out = M^-1 r (3N, b) for cases in `case_mask` (b,); other columns may have any finite values."""
        ...


@cache
def build_block_kernels(device: Device) -> tuple[wp.Kernel, wp.Kernel]:
    """Return the two kernels of the block-Jacobi preconditioner: inversion and product."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector

    @forward_kernel(module="unique")
    def invert_blocks(
        # outputs
        blocks: wp.array2d(dtype=mat),
    ):
        """Replace each block B by B^-1, or by the identity / |B| if B is not positive definite."""
        i, c = wp.tid()
        B = blocks[i, c]
        size = wp.abs(B[0, 0]) + wp.abs(B[1, 1]) + wp.abs(B[2, 2])
        minor = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
        tiny = scalar(1.0e-6) * size
        if B[0, 0] > tiny and minor > tiny * tiny and wp.determinant(B) > tiny * tiny * tiny:
            blocks[i, c] = wp.inverse(B)
        else:
            blocks[i, c] = wp.identity(n=3, dtype=scalar) / wp.max(size, scalar(1.0e-30))

    @forward_kernel(module="unique")
    def multiply_blocks(
        blocks: wp.array2d(dtype=mat),
        r: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute out_i = B_i r_i."""
        i, c = wp.tid()
        x = blocks[i, c] * vec(r[3 * i, c], r[3 * i + 1, c], r[3 * i + 2, c])
        for k in range(3):
            out[3 * i + k, c] = x[k]

    return invert_blocks, multiply_blocks


class BlockJacobi:
    """Block-Jacobi preconditioner: inverse of the 3 x 3 diagonal blocks of the tangent stiffness."""

    on_device = False

    def __init__(self, device: Device):
        self._device = device
        self._blocks: wp.array | None = None

    def prepare(self, problem: Problem, columns: int) -> None:
        """Compute and invert the diagonal blocks at the last linearisation."""
        blocks = problem.compute_diagonal(columns)
        self._device.launch(build_block_kernels(self._device)[0], blocks.shape, [], [blocks])
        self._blocks = blocks

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Compute out = B^-1 r with the diagonal blocks B."""
        assert self._blocks is not None
        self._device.launch(build_block_kernels(self._device)[1], self._blocks.shape, [self._blocks, r], [out])


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Solution x (3N, b), and a mask (b,) of load cases truncated at negative curvature or at the radius.

    `norm` (b,) is the norm sqrt(x . M x) [J^1/2] with the preconditioner M^-1; `iterations` counts those of the batch.
    """

    x: wp.array
    truncated: np.ndarray
    norm: np.ndarray
    iterations: int


def solve_conjugate_gradients(
    problem: Problem,
    preconditioner: Preconditioner,
    r: wp.array,
    tolerance: np.ndarray,
    max_iterations: int,
    radius: np.ndarray | None = None,
) -> LinearSolution:
    """Return the solution of P K P x = r at the last linearisation, with |r| <= tolerance (b,) unless truncated.

    Parameters
    ----------
    r
        Projected right-hand side (3N, b) [N]; overwritten with the residual of the linear system.
    tolerance
        Absolute tolerance (b,) [N] of the 2-norm of the linear residual.
    max_iterations
        Maximum number of iterations.
    radius
        Bound (b,) [J^1/2] of x in the preconditioner's norm; at negative curvature, x is extended to this bound.
        Without a radius, the iteration ends there with the current x or, in the first iteration, its direction.
    """
    device, columns = problem.device, r.shape[1]
    reach = np.full(columns, np.inf) if radius is None else radius
    x, z, q = device.allocate(*r.shape), device.allocate(*r.shape), device.allocate(*r.shape)

    def precondition() -> None:
        preconditioner.apply(r, live, z)
        problem.constraint.project(z)

    live = compute_norms(device, r) > tolerance
    precondition()
    p, rz = wp.clone(z), compute_dots(device, r, z)
    # Inner products x.Mx, x.Mp and p.Mp follow from the coefficients alone: Conn, Gould, Toint 2000, section 7.5.1.
    xx, xp, pp = np.zeros(columns), np.zeros(columns), rz
    truncated = np.zeros(columns, bool)
    iterations = 0
    while live.any() and iterations < max_iterations:
        q.zero_()
        problem.add_curvature(p, q)
        problem.constraint.project(q)
        pq = compute_dots(device, p, q)
        with np.errstate(divide="ignore", invalid="ignore"):
            longest = np.where(reach < np.inf, (np.sqrt(xp**2 + pp * (reach**2 - xx).clip(0.0)) - xp) / pp, np.inf)
            alpha = np.where(pq > 0.0, rz / pq, longest)
        stop = live & (~(pq > 0.0) | (alpha >= longest))
        alpha = np.minimum(alpha, longest)
        # Without a radius, in the first iteration: the preconditioned gradient is a descent direction.
        alpha = np.where(live, np.where(np.isfinite(alpha), alpha, float(iterations == 0)), 0.0)
        combine_columns(device, x, alpha, p, x)
        combine_columns(device, r, -alpha, q, r)
        xx = xx + 2.0 * alpha * xp + alpha**2 * pp
        truncated |= stop
        live &= ~stop & (compute_norms(device, r) > tolerance)
        iterations += 1
        if not live.any():
            break
        precondition()
        before, rz = np.where(live, rz, 1.0), np.where(live, compute_dots(device, r, z), 0.0)
        beta = rz / before
        combine_columns(device, z, beta, p, p)
        xp, pp = beta * (xp + alpha * pp), rz + beta**2 * pp
    return LinearSolution(x, truncated, np.sqrt(xx.clip(0.0)), iterations)

"""Eigenvalues and eigenvectors of symmetric 3 x 3 matrices, accurate to round-off in either precision.

Cyclic Jacobi rotations: Golub, Van Loan 2013, "Matrix Computations", section 8.5. Warp's `eig3` has a relative
error of 1e-3 in single precision if eigenvalues are close.
"""

from typing import Any

import warp as wp


@wp.func
def compute_principal_axes(A: Any):
    """Return eigenvalues e (3,), unsorted, and N (3, 3) whose rows are the eigenvectors: A = N^T diag(e) N."""
    zero, one, two = type(A[0, 0])(0.0), type(A[0, 0])(1.0), type(A[0, 0])(2.0)
    e = wp.get_diag(A)
    off = wp.vector(A[1, 2], A[2, 0], A[0, 1])  # off-diagonal entries, indexed by the rotation axis
    N = wp.identity(n=3, dtype=type(zero))
    for _ in range(8):
        # Converged if the off-diagonal entries are below the round-off of the diagonal ones.
        size = wp.abs(e[0]) + wp.abs(e[1]) + wp.abs(e[2])
        if size + (wp.abs(off[0]) + wp.abs(off[1]) + wp.abs(off[2])) == size:
            break
        for r in range(3):
            p, q = (r + 1) % 3, (r + 2) % 3
            if off[r] != zero:
                theta = (e[q] - e[p]) / (two * off[r])
                t = wp.where(theta < zero, -one, one) / (wp.abs(theta) + wp.sqrt(theta * theta + one))
                c = one / wp.sqrt(t * t + one)
                s = t * c
                e[p] -= t * off[r]
                e[q] += t * off[r]
                off[r] = zero
                along = off[q]
                off[q] = c * along - s * off[p]
                off[p] = s * along + c * off[p]
                first, second = N[p], N[q]
                N[p] = c * first - s * second
                N[q] = s * first + c * second
    return e, N

"""Preconditioned conjugate gradients on a batch of columns, and the preconditioners.

Steihaug 1983, "The conjugate gradient method and trust regions": at negative curvature the iteration stops with what
it has, a descent direction; the first direction is the preconditioned gradient itself.
"""

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import warp as wp

from .columns import add_dots, combined
from .device import Device
from .problem import Problem


class Preconditioner(Protocol):
    """An approximate inverse of the free curvature, symmetric and positive definite."""

    def prepare(self, problem: Problem, columns: int) -> None:
        """Use the last linearisation, if it matters; the batch has so many columns."""
        ...

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """out (3N, b) = M^-1 r (3N, b), in the columns that are `live` (b,); the others may hold anything finite."""
        ...


class Factor:
    """A rest stiffness K over some motions, L (L^T K L)^-1 L^T, factorised once on the host (SuperLU).

    Parameters
    ----------
    stiffness
        K (3N, 3N) [N/m].
    motions
        L (3N, n): independent motions as columns. Their own unknowns, three to a node, are numbered by `node` (n,).
    device
        Where the right-hand sides live; many are solved together.

    Raises
    ------
    RuntimeError
        K is singular over these motions: something is not held.
    """

    def __init__(self, stiffness: sp.csc_array, motions: sp.csc_array, node: np.ndarray, device: Device):
        free = sp.csc_array(motions.T @ stiffness @ motions)
        order = dissection(free, node)
        if order is not None:
            free, motions = free[order][:, order], motions[:, order]
        self._motions = sp.csr_array(motions.astype(device.precision))
        self._transposed = sp.csr_array(self._motions.T)
        # Symmetric ordering without pivoting: the matrix is positive definite.
        self._factor = spl.splu(
            sp.csc_matrix(free.astype(device.precision)),
            permc_spec="MMD_AT_PLUS_A" if order is None else "NATURAL",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """Two triangular solves for each live column: the others would cost as much."""
        values = r.numpy()
        solved = np.zeros_like(values)
        solved[:, live] = self._motions @ self._factor.solve(np.asfortranarray(self._transposed @ values[:, live]))
        out.assign(solved)


def node_of(basis: sp.csc_array) -> np.ndarray:
    """The node (n,) that each column of a constraint's basis (3N, n) moves."""
    return np.asarray(basis.indices[basis.indptr[:-1]] // 3)


def dissection(matrix: sp.csc_array, node: np.ndarray) -> np.ndarray | None:
    """An order (n,) of a matrix's unknowns with little fill: nested dissection of the graph of their nodes by METIS.

    Karypis, Kumar 1998, SIAM J. Sci. Comput. 20:359-392. None without pymetis: SuperLU's own order then costs twice the
    time at 5,000 nodes, and forty times at 17,000.
    """
    try:
        import pymetis
    except ImportError:
        return None
    number, member = np.unique(node, return_inverse=True)
    if not len(number):  # METIS divides by it
        return member
    entry = sp.coo_array(matrix)
    first, second = member[entry.row], member[entry.col]
    across = first != second
    links = np.ones(int(across.sum()), np.int8), (first[across], second[across])
    graph = sp.csr_array(sp.coo_array(links, shape=(len(number),) * 2))
    _, place = pymetis.nested_dissection(pymetis.CSRAdjacency(np.ravel(graph.indptr), np.ravel(graph.indices)))
    return np.argsort(np.asarray(place)[member], kind="stable")


@cache
def block_kernels_of(device: Device) -> tuple[wp.Kernel, wp.Kernel]:
    """Kernels of the block-Jacobi preconditioner."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector

    @wp.kernel(module="unique")
    def invert_blocks(
        # outputs
        blocks: wp.array2d(dtype=mat),
    ):
        """B <- B^-1; the identity over |B| where B is not positive definite."""
        i, c = wp.tid()
        B = blocks[i, c]
        size = wp.abs(B[0, 0]) + wp.abs(B[1, 1]) + wp.abs(B[2, 2])
        minor = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
        tiny = scalar(1.0e-6) * size
        if B[0, 0] > tiny and minor > tiny * tiny and wp.determinant(B) > tiny * tiny * tiny:
            blocks[i, c] = wp.inverse(B)
        else:
            blocks[i, c] = wp.identity(n=3, dtype=scalar) / wp.max(size, scalar(1.0e-30))

    @wp.kernel(module="unique")
    def multiply_blocks(
        blocks: wp.array2d(dtype=mat),
        r: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_i = B_i r_i."""
        i, c = wp.tid()
        x = blocks[i, c] * vec(r[3 * i, c], r[3 * i + 1, c], r[3 * i + 2, c])
        for k in range(3):
            out[3 * i + k, c] = x[k]

    return invert_blocks, multiply_blocks


class BlockJacobi:
    """The 3 x 3 diagonal blocks of the current curvature, inverted: for meshes too large to factorise."""

    def __init__(self, device: Device):
        self._device = device
        self._blocks: wp.array | None = None

    def prepare(self, problem: Problem, columns: int) -> None:
        """Invert the blocks at the last linearisation."""
        blocks = problem.diagonal(columns)
        self._device.launch(block_kernels_of(self._device)[0], blocks.shape, [], [blocks])
        self._blocks = blocks

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """out = B^-1 r, node by node."""
        assert self._blocks is not None
        self._device.launch(block_kernels_of(self._device)[1], self._blocks.shape, [self._blocks, r], [out])


@dataclass(frozen=True)
class StepKernels:
    """The column-wise steps of conjugate gradients; coefficients stay on the device."""

    advance: wp.Kernel
    turn: wp.Kernel


@cache
def step_kernels_of(device: Device) -> StepKernels:
    """Kernels of a device's scalar type."""
    scalar = device.scalar

    @wp.kernel(module="unique")
    def advance(
        live: wp.array(dtype=wp.int32),
        rz: wp.array(dtype=wp.float64),
        pq: wp.array(dtype=wp.float64),
        p: wp.array2d(dtype=scalar),
        q: wp.array2d(dtype=scalar),
        # outputs
        x: wp.array2d(dtype=scalar),
        r: wp.array2d(dtype=scalar),
    ):
        """x += alpha p, r -= alpha q with alpha = r.z / p.q, in live columns of positive curvature."""
        i, c = wp.tid()
        if live[c] == 1 and pq[c] > wp.float64(0.0):
            alpha = scalar(rz[c] / pq[c])
            x[i, c] += alpha * p[i, c]
            r[i, c] -= alpha * q[i, c]

    @wp.kernel(module="unique")
    def turn(
        live: wp.array(dtype=wp.int32),
        rz: wp.array(dtype=wp.float64),
        rz_new: wp.array(dtype=wp.float64),
        z: wp.array2d(dtype=scalar),
        # outputs
        p: wp.array2d(dtype=scalar),
    ):
        """p = z + beta p with beta = new r.z / old r.z."""
        i, c = wp.tid()
        if live[c] == 1:
            p[i, c] = z[i, c] + scalar(rz_new[c] / rz[c]) * p[i, c]

    return StepKernels(advance, turn)


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """x (3N, b); which columns met negative curvature (b,) bool; iterations of the batch."""

    x: wp.array
    truncated: np.ndarray
    iterations: int


def conjugate_gradients(
    problem: Problem, preconditioner: Preconditioner, r: wp.array, tolerance: np.ndarray, most: int
) -> LinearSolution:
    """Solve P K P x = r at the last linearisation, per column until |r| <= tolerance (b,) or curvature is negative.

    Parameters
    ----------
    r
        (3N, b) [N], already projected; overwritten with the residual.
    tolerance
        (b,) [N], absolute.
    most
        Largest number of iterations.
    """
    device, kernels = problem.device, step_kernels_of(problem.device)
    columns = r.shape[1]
    x, z, q = device.zeros(*r.shape), device.zeros(*r.shape), device.zeros(*r.shape)

    def dot(a: wp.array, b: wp.array) -> wp.array:
        out = wp.zeros(columns, dtype=wp.float64, device=device.name)
        add_dots(device, a, b, out)
        return out

    def precondition() -> None:
        preconditioner.apply(r, live, z)
        problem.constraint.project(z)

    live = np.sqrt(dot(r, r).numpy()) > tolerance
    precondition()
    p, rz = wp.clone(z), dot(r, z)
    truncated = np.zeros(columns, bool)
    iterations = 0
    while live.any() and iterations < most:
        q.zero_()
        problem.add_curvature(p, q)
        problem.constraint.project(q)
        pq = dot(p, q)
        negative = live & ~(pq.numpy() > 0.0)
        if negative.any():
            if iterations == 0:  # nothing gathered yet: the preconditioned gradient is a descent direction
                combined(device, x, negative.astype(np.float64), p, x)
            truncated |= negative
            live &= ~negative
        flags = device.array(live.astype(np.int32), wp.int32)
        device.launch(kernels.advance, r.shape, [flags, rz, pq, p, q], [x, r])
        iterations += 1
        live &= np.sqrt(dot(r, r).numpy()) > tolerance
        if not live.any():
            break
        precondition()
        rz_new = dot(r, z)
        flags = device.array(live.astype(np.int32), wp.int32)
        device.launch(kernels.turn, r.shape, [flags, rz, rz_new, z], [p])
        rz = rz_new
    return LinearSolution(x, truncated, iterations)

"""Two levels: Chebyshev smoothing on the rest stiffness, and a coarse solver for what varies slowly.

For quadratic tetrahedra the coarse motions are those of linear ones on the same corners (p-multigrid): Sundar, Stadler,
Biros 2015, "Comparison of multigrid algorithms for high-order continuous finite element discretizations", Numer. Linear
Algebra Appl. 22:664-680. The smoother is Chebyshev's polynomial of block Jacobi: Adams et al. 2003, J. Comput. Phys.
188:593-610.
"""

from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from .columns import combined, dots, gathered, scattered
from .constraint import Constraint
from .device import Device
from .linear import Preconditioner
from .problem import Problem

DEGREE = 3
# The smoother damps eigenvalues from the largest down to this share of it; the coarse solver has the rest.
DAMPED = 1.0 / 8.0
POWER_ITERATIONS = 20
# The power iteration comes from below.
MARGIN = 1.1


@cache
def kernels_of(device: Device) -> tuple[wp.Kernel, wp.Kernel]:
    """Kernels of the sparse product and of the block-diagonal step."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector

    @wp.kernel(module="unique")
    def subtract_product(
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        block: wp.array(dtype=mat),
        x: wp.array2d(dtype=scalar),
        # outputs
        r: wp.array2d(dtype=scalar),
    ):
        """r_i -= sum over j of K_ij x_j."""
        i, c = wp.tid()
        total = vec()
        for k in range(first[i], first[i + 1]):
            j = 3 * column[k]
            total += block[k] * vec(x[j, c], x[j + 1, c], x[j + 2, c])
        for k in range(3):
            r[3 * i + k, c] -= total[k]

    @wp.kernel(module="unique")
    def step(
        inverse: wp.array(dtype=mat),
        kept: scalar,
        added: scalar,
        r: wp.array2d(dtype=scalar),
        # outputs
        d: wp.array2d(dtype=scalar),
    ):
        """d_i = kept d_i + added D_i^-1 r_i."""
        i, c = wp.tid()
        z = inverse[i] * vec(r[3 * i, c], r[3 * i + 1, c], r[3 * i + 2, c])
        for k in range(3):
            d[3 * i + k, c] = kept * d[3 * i + k, c] + added * z[k]

    return subtract_product, step


class TwoLevel:
    """A symmetric cycle: smooth, correct by the coarse solver, smooth.

    Parameters
    ----------
    coarse
        L A^-1 L^T for some motions L, with A at least L^T K L.
    stiffness
        K (3N, 3N) [N/m] at rest.
    constraint
        Which motions are free; what loads impose on it does not matter here.
    device
        Where its arrays live.
    """

    def __init__(self, coarse: Preconditioner, stiffness: sp.csc_array, constraint: Constraint, device: Device):
        self._coarse, self._constraint, self._device = coarse, constraint, device
        blocks = sp.bsr_array(stiffness, blocksize=(3, 3))
        self._product = [
            device.array(blocks.indptr, wp.int32),
            device.array(blocks.indices, wp.int32),
            device.array(blocks.data, device.matrix),
        ]
        self._nodes = len(constraint.held)
        self._inverse = device.array(np.linalg.inv(_diagonal(blocks, self._nodes)), device.matrix)
        self._largest = MARGIN * self._power()

    def prepare(self, problem: Problem, columns: int) -> None:
        """The rest stiffness serves every state."""

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """One cycle for the live columns."""
        columns = np.flatnonzero(live)
        x = self._cycle(gathered(self._device, r, columns))
        scattered(self._device, x, columns, out)

    def _cycle(self, r: wp.array) -> wp.array:
        x, correction = self._device.zeros(*r.shape), self._device.zeros(*r.shape)
        every = np.ones(r.shape[1], bool)
        self._smooth(x, wp.clone(r))
        self._coarse.apply(self._residual(r, x), every, correction)
        self._add(x, correction)
        self._smooth(x, self._residual(r, x))
        return x

    def _smooth(self, x: wp.array, r: wp.array) -> None:
        """Add to x the polynomial of its residual r, which is overwritten. Saad 2003, algorithm 12.1."""
        low = DAMPED * self._largest
        centre, radius = (self._largest + low) / 2.0, (self._largest - low) / 2.0
        ratio = radius / centre
        d = self._device.zeros(*r.shape)
        self._step(0.0, 1.0 / centre, r, d)
        self._add(x, d)
        for _ in range(DEGREE - 1):
            self._subtract(d, r)
            following = 1.0 / (2.0 * centre / radius - ratio)
            self._step(following * ratio, 2.0 * following / radius, r, d)
            self._add(x, d)
            ratio = following

    def _residual(self, r: wp.array, x: wp.array) -> wp.array:
        out = wp.clone(r)
        self._subtract(x, out)
        return out

    def _subtract(self, x: wp.array, r: wp.array) -> None:
        subtract_product, _ = kernels_of(self._device)
        self._device.launch(subtract_product, (r.shape[0] // 3, r.shape[1]), [*self._product, x], [r])
        self._constraint.project_nodes(r)

    def _step(self, kept: float, added: float, r: wp.array, d: wp.array) -> None:
        _, step = kernels_of(self._device)
        scalar = self._device.scalar
        inputs = [self._inverse, scalar(kept), scalar(added), r]
        self._device.launch(step, (r.shape[0] // 3, r.shape[1]), inputs, [d])
        self._constraint.project_nodes(d)

    def _add(self, x: wp.array, d: wp.array) -> None:
        combined(self._device, x, np.ones(x.shape[1]), d, x)

    def _power(self) -> float:
        """The largest eigenvalue of D^-1 K over the free motions."""
        device = self._device
        x = device.array(np.random.default_rng(0).normal(size=(3 * self._nodes, 1)))
        self._constraint.project_nodes(x)
        largest = 1.0
        for _ in range(POWER_ITERATIONS):
            product, new = device.zeros(*x.shape), device.zeros(*x.shape)
            self._subtract(x, product)
            self._step(0.0, -1.0, product, new)
            size = float(np.sqrt(dots(device, new, new)[0]))
            largest = float(dots(device, x, new)[0] / dots(device, x, x)[0])
            x = combined(device, device.zeros(*x.shape), np.array([1.0 / size]), new, x)
        return largest


def _diagonal(blocks: sp.bsr_array, count: int) -> np.ndarray:
    """Diagonal blocks (N, 3, 3) of `count` = N nodes; the identity at nodes of no element."""
    row = np.repeat(np.arange(count), np.diff(blocks.indptr))
    own = row == blocks.indices
    out = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    out[row[own]] = blocks.data[own]
    return out

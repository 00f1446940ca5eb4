"""Boundary conditions as a projection: fixed, prescribed and sliding nodes, and footprints with prescribed motion.

Every constraint is linear, C u = value. `project` maps a gradient or a direction to the subspace of admissible
motions; `close_gap` returns the smallest motion that satisfies the constraints. The node projection P acts on each node
separately. The mean motion W^T u of a footprint adds three rows W^T P, whose Gram matrix is G = W^T P W.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..errors import InputError
from ..runtime.columns import CHUNK, combine_columns, gather_columns
from ..runtime.device import Device, forward_kernel


@dataclass(frozen=True)
class MinFreeDofs:
    """Thresholds below which a node or a footprint counts as fixed.

    Parameters
    ----------
    normal_norm
        Minimum norm of the free components of a slide normal; a smaller normal does not constrain the free components.
    footprint_fraction
        Minimum fraction, in every direction, of the squared footprint weights that is at free components.
    """

    normal_norm: float = 1e-6
    footprint_fraction: float = 1e-2


@dataclass(frozen=True)
class ConstraintKernels:
    """Kernels of the constraints, for one scalar type."""

    project: wp.Kernel
    close_gap: wp.Kernel
    compute_mean: wp.Kernel
    distribute: wp.Kernel


@cache
def build_kernels(device: Device) -> ConstraintKernels:
    """Build the kernels for a device's scalar type."""
    scalar, vec = device.scalar, device.vector
    chunk = CHUNK

    @forward_kernel(module="unique")
    def project_nodes(
        fixed: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """Project v onto the admissible motions: v_i -= n (n . v_i), then fixed components are set to zero."""
        i, c = wp.tid()
        x, n = vec(v[3 * i, c], v[3 * i + 1, c], v[3 * i + 2, c]), normal[i]
        x -= wp.dot(n, x) * n
        for k in range(3):
            v[3 * i + k, c] = wp.where(fixed[i, k] == wp.int8(0), x[k], scalar(0.0))

    @forward_kernel(module="unique")
    def close_gap(
        fixed: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        drag: wp.array(dtype=vec),
        prescribed: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        # outputs
        gap: wp.array2d(dtype=scalar),
    ):
        """Compute gap_i = value - u if fixed, n (drag . value - n . u) if sliding, zero elsewhere."""
        i, c = wp.tid()
        x, n = vec(u[3 * i, c], u[3 * i + 1, c], u[3 * i + 2, c]), normal[i]
        dragged = wp.dot(drag[i], vec(prescribed[3 * i, c], prescribed[3 * i + 1, c], prescribed[3 * i + 2, c]))
        slip = (dragged - wp.dot(n, x)) * n
        for k in range(3):
            r = 3 * i + k
            gap[r, c] = wp.where(fixed[i, k] == wp.int8(0), slip[k], prescribed[r, c] - x[k])

    @forward_kernel(module="unique")
    def compute_mean(
        weights: wp.array2d(dtype=scalar),
        v: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the weighted sum over a chunk of nodes to the mean motion: out_kc += sum of w_ic v_(3i+k)c."""
        block, c = wp.tid()
        total = vec()
        for i in range(block * chunk, wp.min((block + 1) * chunk, weights.shape[0])):
            total += weights[i, c] * vec(v[3 * i, c], v[3 * i + 1, c], v[3 * i + 2, c])
        for k in range(3):
            wp.atomic_add(out, k, c, total[k])

    @forward_kernel(module="unique")
    def distribute(
        weights: wp.array2d(dtype=scalar),
        vectors: wp.array2d(dtype=scalar),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """Distribute amounts to nodes: v_(3i+k)c += w_ic amount_kc."""
        i, c = wp.tid()
        for k in range(3):
            v[3 * i + k, c] += weights[i, c] * vectors[k, c]

    return ConstraintKernels(project_nodes, close_gap, compute_mean, distribute)


class Constraint:
    """Boundary conditions on the displacements of N nodes.

    Parameters
    ----------
    fixed
        Mask (N, 3) of components with prescribed values.
    normal
        Unit normals (N, 3) of sliding nodes, zero elsewhere. If some components of a sliding node are fixed, its free
        components are constrained so that the node stays in its tangent plane.
    device
        Device of the arrays.
    min_free
        Thresholds below which motion counts as fixed.
    """

    def __init__(self, fixed: np.ndarray, normal: np.ndarray, device: Device, min_free: MinFreeDofs = MinFreeDofs()):
        self.fixed, self._freedom = fixed, min_free
        self.normal, drag = _restrict_normals(fixed, normal, min_free.normal_norm)
        self.device = device
        self._fixed = device.upload(fixed.astype(np.int8), wp.int8)
        self._normal = device.upload(self.normal, device.vector)
        self._drag = device.upload(drag, device.vector)
        self._value: wp.array | None = None
        self._weight: wp.array | None = None
        self._target, self._gram = np.zeros((3, 0)), np.zeros((0, 3, 3))

    def begin(self, displacement: np.ndarray | None, footprint: np.ndarray | None, motion: np.ndarray | None) -> None:
        """Set the values `displacement` (3N, b) [m] of fixed components for a batch; None: zero.

        `footprint` has the weights (N, b) of a footprint with the prescribed mean motion `motion` (3, b) [m], or None.

        Raises
        ------
        InputError
            The constraints leave the footprint too little freedom to move.
        """
        self._value = None if displacement is None else self.device.upload(displacement)
        self._weight = None
        if footprint is not None and motion is not None:
            self._weight, self._target = self.device.upload(footprint), motion
            square = footprint**2
            free = np.eye(3) * ~self.fixed[:, None, :] - self.normal[:, :, None] * self.normal[:, None, :]
            self._gram = np.einsum("nb,nij->bij", square, free)
            share = np.linalg.eigvalsh(self._gram)[:, 0] / square.sum(axis=0)
            if (share < self._freedom.footprint_fraction).any():
                raise InputError(
                    f"load {np.argmin(share)} moves a footprint that is (nearly) fixed: choose a free place."
                )

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,) of the batch."""
        if self._value is not None:
            self._value = gather_columns(self.device, self._value, columns)
        if self._weight is not None:
            self._weight = gather_columns(self.device, self._weight, columns)
            self._target, self._gram = self._target[:, columns], self._gram[columns]

    @property
    def node_arrays(self) -> tuple[wp.array, wp.array]:
        """Device arrays that `project_nodes` uses: fixed components (N, 3) int8, and slide normals (N,)."""
        return self._fixed, self._normal

    @property
    def has_motion(self) -> bool:
        """True if the batch prescribes nonzero values or footprint motions."""
        return self._value is not None or self._weight is not None

    def project(self, v: wp.array) -> None:
        """Project v (3N, b) onto the admissible motions, in place."""
        self.project_nodes(v)
        if self._weight is not None:
            self._distribute_mean(-self._compute_mean(v), v)
            self.project_nodes(v)

    def project_nodes(self, v: wp.array) -> None:
        """Project v (3N, b) in place onto the motions that fixed and sliding nodes admit, regardless of footprints."""
        dim = (len(self.fixed), v.shape[1])
        self.device.launch(build_kernels(self.device).project, dim, [self._fixed, self._normal], [v])

    def close_gap(self, u: wp.array) -> tuple[wp.array, np.ndarray]:
        """Return the smallest motion (3N, b) [m] that makes u (3N, b) satisfy the constraints, and its maximum (b,)."""
        gap = self.device.allocate(*u.shape)
        value = self._value if self._value is not None else gap
        inputs = [self._fixed, self._normal, self._drag, value, u]
        self.device.launch(build_kernels(self.device).close_gap, (len(self.fixed), u.shape[1]), inputs, [gap])
        if self._weight is not None:
            rest, reached = self.device.allocate(*u.shape), self._compute_mean(u) + self._compute_mean(gap)
            self._distribute_mean(self._target - reached, rest)
            self.project_nodes(rest)
            combine_columns(self.device, gap, 1.0, rest, gap)
        return gap, np.abs(gap.numpy()).max(axis=0, initial=0.0)

    def sum_by_value(self, force: np.ndarray) -> np.ndarray:
        """Return the work of forces (B, N, 3) [N] per unit of each prescribed value; zero at free components."""
        along = np.einsum("bni,ni->bn", force, self.normal)
        return np.where(self.fixed, force + along[:, :, None] * self._drag.numpy(), 0.0)

    def compute_footprint_force(self, gradient: wp.array) -> np.ndarray | None:
        """Return the force (3, b) [N] of the tool on its footprint, by Lagrange multipliers; None without a footprint.

        In equilibrium, P gradient = P W force. The array `gradient` (3N, b) is projected in place.
        """
        if self._weight is None:
            return None
        self.project_nodes(gradient)
        return self._solve_gram(self._compute_mean(gradient))

    def build_basis(self) -> sp.csc_array:
        """Return a sparse orthonormal basis (3N, n) of the motions that the fixed and sliding nodes admit."""
        sliding = (self.normal != 0.0).any(axis=1)
        rows = [np.flatnonzero(~self.fixed & ~sliding[:, None])]
        columns, values = [np.arange(len(rows[0]))], [np.ones(len(rows[0]))]
        count = len(rows[0])
        for fixed_count in range(2):  # with two fixed components a sliding node is fully constrained
            node = np.flatnonzero(sliding & (self.fixed.sum(axis=1) == fixed_count))
            # Free directions: orthogonal complement of the fixed axes and the normal.
            axes = np.eye(3)[np.nonzero(self.fixed[node])[1]].reshape(len(node), fixed_count, 3)
            free = np.linalg.svd(np.concatenate([axes, self.normal[node, None]], axis=1))[2][:, fixed_count + 1 :]
            number = count + np.arange(len(node) * (2 - fixed_count))
            rows.append(np.repeat(3 * node[:, None] + np.arange(3), 2 - fixed_count, axis=0).ravel())
            columns.append(np.repeat(number, 3))
            values.append(free.ravel())
            count += len(number)
        data = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return sp.csc_array(sp.coo_array(data, shape=(self.fixed.size, count)))

    def _compute_mean(self, v: wp.array) -> np.ndarray:
        assert self._weight is not None
        out = self.device.allocate(3, v.shape[1])
        dim = (-(-len(self.fixed) // CHUNK), v.shape[1])
        self.device.launch(build_kernels(self.device).compute_mean, dim, [self._weight, v], [out])
        return out.numpy().astype(np.float64)

    def _solve_gram(self, mean: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self._gram, mean.T[:, :, None])[:, :, 0].T

    def _distribute_mean(self, mean: np.ndarray, v: wp.array) -> None:
        inputs = [self._weight, self.device.upload(self._solve_gram(mean))]
        self.device.launch(build_kernels(self.device).distribute, (len(self.fixed), v.shape[1]), inputs, [v])


def _restrict_normals(fixed: np.ndarray, normal: np.ndarray, min_norm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the slide normals (N, 3) without their fixed components, normalised; zero if the norm is below `min_norm`.

    Also return `drag` (N, 3): motion along the normal per unit of each fixed component that keeps a node in its plane.
    """
    inside = np.where(fixed, 0.0, normal)
    length = np.linalg.norm(inside, axis=1, keepdims=True)
    left = length > min_norm
    unit = np.divide(inside, length, out=np.zeros_like(inside), where=left)
    drag = np.divide(inside - normal, length, out=np.zeros_like(inside), where=left)
    return unit, drag

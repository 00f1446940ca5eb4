"""Held, prescribed and sliding nodes, and footprints that a tool moves: one projection for all of them.

Every constraint is linear, C u = value. `project` takes a gradient or a direction to the space of motions that the
constraints leave free; `close_gap` is the least motion that satisfies them. Nodes come first: P projects each by
itself. A footprint's mean motion W^T u then adds the three rows W^T P, with their Gram matrix G = W^T P W.
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
    """How little may be left free before it counts as held.

    Parameters
    ----------
    normal
        A normal, of which held components leave less than this, says nothing about the others.
    footprint
        Of a footprint that a tool moves, at least this share of the squared weights must be free in every direction.
    """

    normal: float = 1e-6
    footprint: float = 1e-2


@dataclass(frozen=True)
class ConstraintKernels:
    """Constraint arithmetic of one scalar type."""

    project: wp.Kernel
    close: wp.Kernel
    average: wp.Kernel
    spread: wp.Kernel


@cache
def build_kernels(device: Device) -> ConstraintKernels:
    """Kernels of a device's scalar type."""
    scalar, vec = device.scalar, device.vector
    chunk = CHUNK

    @forward_kernel(module="unique")
    def project(
        held: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """v_i -= n (n . v_i); held components of v are zero."""
        i, c = wp.tid()
        x = vec(v[3 * i, c], v[3 * i + 1, c], v[3 * i + 2, c])
        n = normal[i]
        x -= wp.dot(n, x) * n
        for k in range(3):
            v[3 * i + k, c] = wp.where(held[i, k] == wp.int8(0), x[k], scalar(0.0))

    @forward_kernel(module="unique")
    def close(
        held: wp.array2d(dtype=wp.int8),
        normal: wp.array(dtype=vec),
        drag: wp.array(dtype=vec),
        value: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        # outputs
        gap: wp.array2d(dtype=scalar),
    ):
        """gap_i = value - u where held, n (drag . value - n . u) where sliding, zero elsewhere."""
        i, c = wp.tid()
        x = vec(u[3 * i, c], u[3 * i + 1, c], u[3 * i + 2, c])
        n = normal[i]
        dragged = wp.dot(drag[i], vec(value[3 * i, c], value[3 * i + 1, c], value[3 * i + 2, c]))
        slip = (dragged - wp.dot(n, x)) * n
        for k in range(3):
            r = 3 * i + k
            gap[r, c] = wp.where(held[i, k] == wp.int8(0), slip[k], value[r, c] - x[k])

    @forward_kernel(module="unique")
    def average(
        weight: wp.array2d(dtype=scalar),
        v: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out_kc += sum over a chunk of nodes of w_ic v_(3i+k)c."""
        block, c = wp.tid()
        total = vec()
        for i in range(block * chunk, wp.min((block + 1) * chunk, weight.shape[0])):
            total += weight[i, c] * vec(v[3 * i, c], v[3 * i + 1, c], v[3 * i + 2, c])
        for k in range(3):
            wp.atomic_add(out, k, c, total[k])

    @forward_kernel(module="unique")
    def spread(
        weight: wp.array2d(dtype=scalar),
        amount: wp.array2d(dtype=scalar),
        # outputs
        v: wp.array2d(dtype=scalar),
    ):
        """v_(3i+k)c += w_ic amount_kc."""
        i, c = wp.tid()
        for k in range(3):
            v[3 * i + k, c] += weight[i, c] * amount[k, c]

    return ConstraintKernels(project, close, average, spread)


class Constraint:
    """Which motions of N nodes are free.

    Parameters
    ----------
    held
        (N, 3) bool: components whose value is prescribed.
    normal
        (N, 3): unit normals of sliding nodes, zero elsewhere. Where components of a sliding node are held, the
        others follow them along the plane.
    device
        Where its arrays live.
    freedom
        What counts as held.
    """

    def __init__(self, held: np.ndarray, normal: np.ndarray, device: Device, freedom: MinFreeDofs = MinFreeDofs()):
        self.held, self._freedom = held, freedom
        self.normal, drag = _within_free(held, normal, freedom.normal)
        self.device = device
        self._held = device.array(held.astype(np.int8), wp.int8)
        self._normal = device.array(self.normal, device.vector)
        self._drag = device.array(drag, device.vector)
        self._value: wp.array | None = None
        self._weight: wp.array | None = None
        self._target, self._gram = np.zeros((3, 0)), np.zeros((0, 3, 3))

    def begin(self, value: np.ndarray | None, weight: np.ndarray | None, target: np.ndarray | None) -> None:
        """Take a batch of values (3N, b) [m] for held components; None holds them at zero.

        Footprint weights (N, b) whose mean motion is `target` (3, b) [m], or None.

        Raises
        ------
        InputError
            A footprint of which too little is free to move.
        """
        self._value = None if value is None else self.device.array(value)
        self._weight = None
        if weight is not None and target is not None:
            self._weight, self._target = self.device.array(weight), target
            square = weight**2
            free = np.eye(3) * ~self.held[:, None, :] - self.normal[:, :, None] * self.normal[:, None, :]
            self._gram = np.einsum("nb,nij->bij", square, free)
            share = np.linalg.eigvalsh(self._gram)[:, 0] / square.sum(axis=0)
            if (share < self._freedom.footprint).any():
                raise InputError(
                    f"load {np.argmin(share)} moves a footprint that is held, wholly or nearly: choose a free place."
                )

    def keep(self, columns: np.ndarray) -> None:
        """Keep these columns (k,) of the batch."""
        if self._value is not None:
            self._value = gather_columns(self.device, self._value, columns)
        if self._weight is not None:
            self._weight = gather_columns(self.device, self._weight, columns)
            self._target, self._gram = self._target[:, columns], self._gram[columns]

    @property
    def nodes(self) -> tuple[wp.array, wp.array]:
        """What `project_nodes` needs, on the device: held components (N, 3) int8 and normals (N,)."""
        return self._held, self._normal

    @property
    def imposes(self) -> bool:
        """Whether the batch moves held components or footprints."""
        return self._value is not None or self._weight is not None

    def project(self, v: wp.array) -> None:
        """Remove from v (3N, b) what the constraints forbid, in place."""
        self.project_nodes(v)
        if self._weight is not None:
            self._spread(-self._average(v), v)
            self.project_nodes(v)

    def project_nodes(self, v: wp.array) -> None:
        """Remove from v (3N, b) what held and sliding nodes forbid, in place, whatever the loads."""
        dim = (len(self.held), v.shape[1])
        self.device.launch(build_kernels(self.device).project, dim, [self._held, self._normal], [v])

    def close_gap(self, u: wp.array) -> tuple[wp.array, np.ndarray]:
        """The least motion (3N, b) that takes u (3N, b) to the constraints, and its largest component (b,) [m]."""
        gap = self.device.zeros(*u.shape)
        value = self._value if self._value is not None else gap
        inputs = [self._held, self._normal, self._drag, value, u]
        self.device.launch(build_kernels(self.device).close, (len(self.held), u.shape[1]), inputs, [gap])
        if self._weight is not None:
            rest = self.device.zeros(*u.shape)
            reached = self._average(u) + self._average(gap)
            self._spread(self._target - reached, rest)
            self.project_nodes(rest)
            combine_columns(self.device, gap, 1.0, rest, gap)
        return gap, np.abs(gap.numpy()).max(axis=0, initial=0.0)

    def compute_footprint_force(self, gradient: wp.array) -> np.ndarray | None:
        """Return the multipliers (3, b) [N]: the force with which the tool moves its footprint, or None without one.

        In equilibrium P gradient = P W force. The gradient (3N, b) is projected in place.
        """
        if self._weight is None:
            return None
        self.project_nodes(gradient)
        return self._solved(self._average(gradient))

    def basis(self) -> sp.csc_array:
        """Orthonormal basis (3N, n) of the motions that held and sliding nodes leave free, sparse."""
        sliding = (self.normal != 0.0).any(axis=1)
        rows = [np.flatnonzero(~self.held & ~sliding[:, None])]
        columns, values = [np.arange(len(rows[0]))], [np.ones(len(rows[0]))]
        count = len(rows[0])
        for fixed in range(2):  # with two components held a sliding node has no direction left
            node = np.flatnonzero(sliding & (self.held.sum(axis=1) == fixed))
            # Free directions: the orthogonal complement of the held axes and the normal.
            axes = np.eye(3)[np.nonzero(self.held[node])[1]].reshape(len(node), fixed, 3)
            free = np.linalg.svd(np.concatenate([axes, self.normal[node, None]], axis=1))[2][:, fixed + 1 :]
            number = count + np.arange(len(node) * (2 - fixed))
            rows.append(np.repeat(3 * node[:, None] + np.arange(3), 2 - fixed, axis=0).ravel())
            columns.append(np.repeat(number, 3))
            values.append(free.ravel())
            count += len(number)
        data = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return sp.csc_array(sp.coo_array(data, shape=(self.held.size, count)))

    def _average(self, v: wp.array) -> np.ndarray:
        assert self._weight is not None
        out = self.device.zeros(3, v.shape[1])
        dim = (-(-len(self.held) // CHUNK), v.shape[1])
        self.device.launch(build_kernels(self.device).average, dim, [self._weight, v], [out])
        return out.numpy().astype(np.float64)

    def _solved(self, mean: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self._gram, mean.T[:, :, None])[:, :, 0].T

    def _spread(self, mean: np.ndarray, v: wp.array) -> None:
        inputs = [self._weight, self.device.array(self._solved(mean))]
        self.device.launch(build_kernels(self.device).spread, (len(self.held), v.shape[1]), inputs, [v])


def _within_free(held: np.ndarray, normal: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (N, 3) with their held components removed, of unit length again.

    Zero where next to nothing is left.

    And (N, 3) the motion along them that a unit of each held component causes: normal . u stays zero.
    """
    inside = np.where(held, 0.0, normal)
    length = np.linalg.norm(inside, axis=1, keepdims=True)
    left = length > least
    unit = np.divide(inside, length, out=np.zeros_like(inside), where=left)
    drag = np.divide(inside - normal, length, out=np.zeros_like(inside), where=left)
    return unit, drag

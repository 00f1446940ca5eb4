"""Elastic energy of one region: the integral of psi(H) over the rest volume, for any law and element."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..device import Device
from ..element import Elements, hooke_stiffness
from ..term import Cases
from ..together import cores, together
from .invariants import cofactor
from .law import Law

# A step must leave every volume above this share of what it was: the logarithm and its curvature stay moderate.
VOLUME_KEPT = 0.1


@dataclass(frozen=True, eq=False)
class _Part:
    """Some of the elements: how many; sizes, node numbers and shape gradients; weights and coefficients."""

    count: int
    shape: list[wp.array]
    inside: list[wp.array]


@dataclass(frozen=True)
class Kernels:
    """The compiled loops over elements of one law."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    bound_step: wp.Kernel | None


@cache
def kernels_of(law: Law, device: Device, size: int, count: int) -> Kernels:
    """Kernels for elements of `size` nodes and laws of `count` coefficients.

    Each launches over (element, column). Elements of `size` 0 have as many nodes as `sizes` says, each its own number.
    """
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)
    stress, stress_change, density = law.stress, law.stress_change, law.energy
    kept = VOLUME_KEPT

    # Loops over nodes are unrolled where `size` is a constant, a fifth less time on the CPU; over points too, they take
    # thrice as long to compile. Shape gradients sum to zero: only how far nodes moved from node 0 counts.
    @wp.func
    def gradient_of(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        e: int,
        q: int,
        c: int,
    ):
        """H = sum over nodes of (u_a - u_0) (x) grad N_a."""
        H = mat()
        i = 3 * table[e, 0]
        origin = vec(u[i, c], u[i + 1, c], u[i + 2, c])
        for a in range(1, size if size else sizes[e]):
            i = 3 * table[e, a]
            H += wp.outer(vec(u[i, c], u[i + 1, c], u[i + 2, c]) - origin, gradient[e, q, a])
        return H

    @wp.func
    def spread(
        P: mat,
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        e: int,
        q: int,
        c: int,
        out: wp.array2d(dtype=scalar),
    ):
        """f_a += P grad N_a; they sum to zero."""
        total = vec()
        for a in range(1, size if size else sizes[e]):
            i = 3 * table[e, a]
            f = P * gradient[e, q, a]
            total += f
            for k in range(3):
                wp.atomic_add(out, i + k, c, f[k])
        i = 3 * table[e, 0]
        for k in range(3):
            wp.atomic_sub(out, i + k, c, total[k])

    @wp.kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        weight: wp.array2d(dtype=scalar),
        coefficients: wp.array(dtype=constants),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """E += sum over points of w psi(H)."""
        e, c = wp.tid()
        for q in range(gradient.shape[1]):
            H = gradient_of(u, sizes, table, gradient, e, q, c)
            wp.atomic_add(out, c, wp.float64(weight[e, q] * density(H, coefficients[e])))

    @wp.kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        weight: wp.array2d(dtype=scalar),
        coefficients: wp.array(dtype=constants),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f_a += sum over points of w P(H) grad N_a."""
        e, c = wp.tid()
        for q in range(gradient.shape[1]):
            P = weight[e, q] * stress(gradient_of(u, sizes, table, gradient, e, q, c), coefficients[e])
            spread(P, sizes, table, gradient, e, q, c, out)

    @wp.kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        at: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        weight: wp.array2d(dtype=scalar),
        coefficients: wp.array(dtype=constants),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f_a += sum over points of w dP(H; D) grad N_a; `definite` columns take the curvature at rest."""
        e, c = wp.tid()
        for q in range(gradient.shape[1]):
            H = mat()
            if definite[c] == 0:
                H = gradient_of(at, sizes, table, gradient, e, q, c)
            D = gradient_of(p, sizes, table, gradient, e, q, c)
            P = weight[e, q] * stress_change(H, D, coefficients[e])
            spread(P, sizes, table, gradient, e, q, c, out)

    @wp.func
    def along(H: mat, of: constants, k: int, m: int):
        """dP for dF = e_k (x) e_m."""
        D = mat()
        D[k, m] = scalar(1.0)
        return stress_change(H, D, of)

    # Unrolled, its many stress changes take ten seconds to compile.
    @wp.kernel(module="unique", module_options={"max_unroll": 0})
    def add_diagonal(
        at: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        weight: wp.array2d(dtype=scalar),
        coefficients: wp.array(dtype=constants),
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """K_aa += sum over points of w dP(H; e_k (x) grad N_a) grad N_a, column k of the block.

        Nine stress changes serve all nodes of a point.
        """
        e, c = wp.tid()
        for q in range(gradient.shape[1]):
            H = mat()
            if definite[c] == 0:
                H = gradient_of(at, sizes, table, gradient, e, q, c)
            for k in range(3):
                X = along(H, coefficients[e], k, 0)
                Y = along(H, coefficients[e], k, 1)
                Z = along(H, coefficients[e], k, 2)
                for a in range(size if size else sizes[e]):
                    g = gradient[e, q, a]
                    f = weight[e, q] * ((g[0] * X + g[1] * Y + g[2] * Z) * g)
                    block = mat()
                    for i in range(3):
                        block[i, k] = f[i]
                    wp.atomic_add(out, table[e, a], c, block)

    @wp.kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """Halve t until J(t) = det(F + t D) >= kept J(0) on all of [0, t]; J is a cubic in t."""
        e, c = wp.tid()
        one = scalar(1.0)
        for q in range(gradient.shape[1]):
            H = gradient_of(u, sizes, table, gradient, e, q, c)
            D = gradient_of(du, sizes, table, gradient, e, q, c)
            F = wp.identity(n=3, dtype=scalar) + H
            normal, normal_change = cofactor(F), cofactor(D)
            a0 = wp.dot(F[0], normal[0])
            a1 = wp.ddot(normal, D)
            a2 = wp.ddot(F, normal_change)
            a3 = wp.dot(D[0], normal_change[0])
            floor = scalar(kept) * a0
            t = out[c]
            zero = scalar(0.0)
            # Most steps are so short that nothing has to be looked at closely.
            if a0 + t * (wp.min(a1, zero) + t * (wp.min(a2, zero) + t * wp.min(a3, zero))) >= floor:
                continue
            for _ in range(40):
                low = a0 + t * (a1 + t * (a2 + t * a3))
                # Stationary points of the cubic inside (0, t), by the root formula that does not cancel.
                root = a2 * a2 - scalar(3.0) * a1 * a3
                if root > scalar(0.0):
                    s = -(a2 + wp.where(a2 >= scalar(0.0), one, -one) * wp.sqrt(root))
                    if a3 != scalar(0.0):
                        t1 = s / (scalar(3.0) * a3)
                        if t1 > scalar(0.0) and t1 < t:
                            low = wp.min(low, a0 + t1 * (a1 + t1 * (a2 + t1 * a3)))
                    if s != scalar(0.0):
                        t2 = a1 / s
                        if t2 > scalar(0.0) and t2 < t:
                            low = wp.min(low, a0 + t2 * (a1 + t2 * (a2 + t2 * a3)))
                if low >= floor:
                    break
                t = t / scalar(2.0)
            wp.atomic_min(out, c, t)

    return Kernels(
        add_energy, add_gradient, add_curvature, add_diagonal, bound_step if law.needs_positive_volume else None
    )


class Elasticity:
    """A Term: hyperelastic energy of some elements.

    Parameters
    ----------
    name
        Unique in its problem.
    law
        The energy density.
    elements
        T elements.
    coefficients
        (T, k) of the law.
    lame
        (T, 2) Lamé's mu and lambda at small strain [Pa].
    device
        Where its arrays live.
    """

    constant, passive, steep = False, True, False

    def __init__(
        self, name: str, law: Law, elements: Elements, coefficients: np.ndarray, lame: np.ndarray, device: Device
    ):
        self.name = name
        self._device = device
        count = coefficients.shape[1]
        size = elements.table.shape[1] if elements.size is None else 0
        sizes = np.zeros(0, np.int32) if elements.size is None else elements.size
        self._kernels = kernels_of(law, device, size, count)
        self._rest, self._tissue = (elements, *lame.T), (law, coefficients)
        shape = [
            device.array(sizes, wp.int32),
            device.array(elements.table, wp.int32),
            device.array(elements.gradient, device.vector),
        ]
        inside = [
            device.array(elements.weight),
            device.array(coefficients, wp.types.vector(length=count, dtype=device.scalar)),
        ]
        every = len(elements.table)
        ends = np.linspace(0, every, (1 if device.on_cuda else cores(every)) + 1).astype(int).tolist()
        self._parts = [
            _Part(stop - first, *([_rows(array, first, stop) for array in arrays] for arrays in (shape, inside)))
            for first, stop in pairwise(ends)
        ]
        self._at: wp.array | None = None
        self._definite: wp.array | None = None

    def begin(self, cases: Cases) -> None:
        """Elasticity remembers nothing."""

    def keep(self, columns: np.ndarray) -> None:
        """Columns are all alike to elasticity."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E += sum of w psi(H)."""
        self._launch(self._kernels.add_energy, [u], out, u.shape[1])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """f += internal forces."""
        self._launch(self._kernels.add_gradient, [u], out, u.shape[1])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Curvature is recomputed from u; where `definite`, Hooke's at rest stands in: positive definite."""
        self._at, self._definite = wp.clone(u), definite

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, self._at, self._definite], out, p.shape[1])

    def add_diagonal(self, out: wp.array) -> None:
        """Blocks += diagonal of K(u)."""
        self._launch(self._kernels.add_diagonal, [self._at, self._definite], out, out.shape[1])

    def rest_curvature(self) -> sp.csc_array:
        """Hooke's stiffness, which every law meets at rest."""
        return hooke_stiffness(*self._rest)

    def curvature(self) -> sp.csc_array:
        """K(u) (3N, 3N) [N/m] of one column, assembled: each element by itself, along every motion of its nodes."""
        assert self._at is not None
        elements = self._rest[0]
        count, size = len(elements.table), 3 * elements.table.shape[1]
        dof = (3 * elements.table[:, :, None] + np.arange(3)).reshape(count, size)
        u = self._device.array(np.repeat(self._at.numpy()[dof.ravel()], size, axis=1))
        self._apart.linearise(u, self._device.array(np.zeros(size), wp.int32))
        out = self._device.zeros(count * size, size)
        self._apart.add_curvature(self._device.array(np.tile(np.eye(size), (count, 1))), out)
        place = np.repeat(dof, size, axis=1).ravel(), np.tile(dof, size).ravel()
        entries = out.numpy().ravel().astype(np.float64)
        return sp.csc_array(sp.coo_array((entries, place), shape=(3 * elements.nodes,) * 2))

    @cached_property
    def _apart(self) -> "Elasticity":
        """The same elements, each with nodes of its own."""
        elements, law, coefficients = self._rest[0], *self._tissue
        table = np.arange(elements.table.size, dtype=np.int32).reshape(elements.table.shape)
        apart = replace(elements, table=table, nodes=table.size)
        return Elasticity(self.name, law, apart, coefficients, np.column_stack(self._rest[1:]), self._device)

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Bound the step where the law needs J > 0."""
        kernel = self._kernels.bound_step
        if kernel is not None:
            bounds = [out, *(wp.clone(out) for _ in self._parts[1:])]
            self._each(kernel, lambda part: [u, du, *part.shape], bounds, u.shape[1])
            for bound in bounds[1:]:
                np.minimum(out.numpy(), bound.numpy(), out=out.numpy())

    def end(self, u: wp.array) -> None:
        """Elasticity remembers nothing."""

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, columns: int) -> None:
        """Add to `out` whatever a kernel adds."""
        sums = [out, *(wp.zeros_like(out) for _ in self._parts[1:])]
        self._each(kernel, lambda part: [*inputs, *part.shape, *part.inside], sums, columns)
        for total in sums[1:]:
            np.add(out.numpy(), total.numpy(), out=out.numpy())

    def _each(
        self, kernel: wp.Kernel, inputs: Callable[[_Part], list], outputs: Sequence[wp.array], columns: int
    ) -> None:
        """All parts at the same time, each into an output of its own."""
        together(
            [
                partial(self._device.launch, kernel, (part.count, columns), inputs(part), [out])
                for part, out in zip(self._parts, outputs, strict=True)
            ]
        )


def _rows(array: wp.array, first: int, stop: int) -> wp.array:
    """A view of some rows; of nothing, nothing."""
    return array[first:stop] if len(array) else array

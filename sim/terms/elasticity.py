"""Elastic energy of one region: the integral of psi(H) over the rest volume, for any law and element."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..device import Device
from ..element import Elements, hooke_stiffness
from ..term import Cases
from .invariants import cofactor, volume_change
from .law import Law

# A step must leave every volume above this share of what it was: the logarithm and its curvature stay moderate.
VOLUME_KEPT = 0.1


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

    # A constant bound lets the compiler unroll the loops over nodes; unrolled over points too, it takes thrice as long.
    @wp.func
    def constant(sizes: wp.array(dtype=wp.int32), e: int):
        return size

    @wp.func
    def stored(sizes: wp.array(dtype=wp.int32), e: int):
        return sizes[e]

    nodes_of = constant if size else stored

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
        """H = sum over nodes of u_a (x) grad N_a."""
        H = mat()
        for a in range(nodes_of(sizes, e)):
            i = 3 * table[e, a]
            H += wp.outer(vec(u[i, c], u[i + 1, c], u[i + 2, c]), gradient[e, q, a])
        return H

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
            for a in range(nodes_of(sizes, e)):
                i = 3 * table[e, a]
                f = P * gradient[e, q, a]
                for k in range(3):
                    wp.atomic_add(out, i + k, c, f[k])

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
            for a in range(nodes_of(sizes, e)):
                i = 3 * table[e, a]
                f = P * gradient[e, q, a]
                for k in range(3):
                    wp.atomic_add(out, i + k, c, f[k])

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
                for a in range(nodes_of(sizes, e)):
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
            a0 = one + volume_change(H)
            a1 = wp.ddot(cofactor(F), D)
            a2 = wp.ddot(F, cofactor(D))
            a3 = wp.determinant(D)
            floor = scalar(kept) * a0
            t = out[c]
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

    constant = False

    def __init__(
        self, name: str, law: Law, elements: Elements, coefficients: np.ndarray, lame: np.ndarray, device: Device
    ):
        self.name = name
        self._device = device
        count = coefficients.shape[1]
        size = elements.table.shape[1] if elements.size is None else 0
        sizes = np.zeros(0, np.int32) if elements.size is None else elements.size
        self._kernels = kernels_of(law, device, size, count)
        self._rest = (elements, *lame.T)
        self._shape = [
            device.array(sizes, wp.int32),
            device.array(elements.table, wp.int32),
            device.array(elements.gradient, device.vector),
        ]
        self._weight = device.array(elements.weight)
        self._coefficients = device.array(coefficients, wp.types.vector(length=count, dtype=device.scalar))
        self._at: wp.array | None = None
        self._definite: wp.array | None = None

    def begin(self, cases: Cases) -> None:
        """Elasticity remembers nothing."""

    def keep(self, columns: np.ndarray) -> None:
        """Columns are all alike to elasticity."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E += sum of w psi(H)."""
        self._launch(self._kernels.add_energy, [u, *self._shape, self._weight, self._coefficients], out, u)

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """f += internal forces."""
        self._launch(self._kernels.add_gradient, [u, *self._shape, self._weight, self._coefficients], out, u)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Curvature is recomputed from u; where `definite`, Hooke's at rest stands in: positive definite."""
        self._at, self._definite = wp.clone(u), definite

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """f += K(u) p."""
        inputs = [p, self._at, self._definite, *self._shape, self._weight, self._coefficients]
        self._launch(self._kernels.add_curvature, inputs, out, p)

    def add_diagonal(self, out: wp.array) -> None:
        """Blocks += diagonal of K(u)."""
        inputs = [self._at, self._definite, *self._shape, self._weight, self._coefficients]
        self._launch(self._kernels.add_diagonal, inputs, out, out)

    def rest_curvature(self) -> sp.csc_array:
        """Hooke's stiffness, which every law meets at rest."""
        return hooke_stiffness(*self._rest)

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Bound the step where the law needs J > 0."""
        if self._kernels.bound_step is not None:
            self._launch(self._kernels.bound_step, [u, du, *self._shape], out, u)

    def end(self, u: wp.array) -> None:
        """Elasticity remembers nothing."""

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, batch: wp.array) -> None:
        self._device.launch(kernel, (len(self._rest[0].table), batch.shape[1]), inputs, [out])

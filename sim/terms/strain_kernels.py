"""Warp kernels over strained elements: norm of the displacement gradient, and stiffness increment."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.device import Device, forward_kernel
from .element_functions import build_functions
from .laws.law import Law


@dataclass(frozen=True)
class StrainKernels:
    """Kernels over a subset of the elements with one law."""

    strain: wp.Kernel
    stiffen: wp.Kernel


@cache
def build_kernels(law: Law, device: Device, size: int, count: int) -> StrainKernels:
    """Return kernels, arguments as `element_kernels.build_kernels`, launched over (index in `some`, in `columns`)."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)
    stress_change = law.stress_change
    functions = build_functions(law, device, size, count)
    gradient_of, numbers = functions.gradient, functions.array_type
    at, at_rest = functions.get_coefficients, functions.get_rest_coefficients

    @forward_kernel(module="unique")
    def strain(
        some: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute s_a = max over points of |H|, at every node of the elements."""
        i, c = wp.tid()
        e, of = some[i], columns[c]
        most = scalar(0.0)
        for q in range(gradient.shape[1]):
            H = gradient_of(u, sizes, table, gradient, e, q, of)
            most = wp.max(most, wp.sqrt(wp.ddot(H, H)))
        for a in range(size if size else sizes[e]):
            wp.atomic_max(out, table[e, a], c, most)

    @wp.func
    def stiffer(H: mat, k: constants, rest: constants, i: int, j: int):
        """Return dP(H; D) - dP(0; D) for D = e_i (x) e_j."""
        D = mat()
        D[i, j] = scalar(1.0)
        return stress_change(H, D, k) - stress_change(mat(), D, rest)

    # Unrolled, its many stress changes take long to compile.
    @forward_kernel(module="unique", module_options={"max_unroll": 0})
    def stiffen(
        some: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        least: wp.array(dtype=scalar),
        place: wp.array2d(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=wp.int32),
        gradient: wp.array3d(dtype=vec),
        weight: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add w grad N_a . (dP(H) - dP(0)) . grad N_b of points with |H| > least to K_ab, at the indices `place`."""
        i, c = wp.tid()
        e, of = some[i], columns[c]
        nodes = wp.int32(size)
        if nodes == 0:
            nodes = sizes[e]
        for q in range(gradient.shape[1]):
            H = gradient_of(u, sizes, table, gradient, e, q, of)
            if wp.sqrt(wp.ddot(H, H)) > least[c]:
                k = at(coefficients, e, q, of)
                rest = at_rest(k)
                for j in range(3):
                    X = weight[e, q] * stiffer(H, k, rest, j, 0)
                    Y = weight[e, q] * stiffer(H, k, rest, j, 1)
                    Z = weight[e, q] * stiffer(H, k, rest, j, 2)
                    for b in range(nodes):
                        g = gradient[e, q, b]
                        Q = g[0] * X + g[1] * Y + g[2] * Z
                        column = 3 * place[table[e, b], c] + j
                        for a in range(nodes):
                            f = Q * gradient[e, q, a]
                            row = 3 * place[table[e, a], c]
                            for m in range(3):
                                wp.atomic_add(out, c, row + m, column, wp.float64(f[m]))

    return StrainKernels(strain, stiffen)

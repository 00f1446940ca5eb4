"""Warp kernels for the stiffness of strained elements: norm of the displacement gradient, tangents, and increments."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.device import Device, forward_kernel
from .element_functions import build_functions
from .laws.law import Law


@dataclass(frozen=True)
class StrainKernels:
    """Kernels over the elements with one law, or a subset of these."""

    compute_tangents: wp.Kernel
    update_max_strain: wp.Kernel
    add_stiffening: wp.Kernel


@cache
def build_kernels(law: Law, device: Device, size: int, count: int) -> StrainKernels:
    """Return the kernels, with arguments as `element_kernels.build_kernels`, launched over (element, load case)."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)
    stress_change = law.stress_change
    functions = build_functions(law, device, size, count)
    compute_gradient, numbers = functions.compute_gradient, functions.array_type
    get_coefficients, get_rest_coefficients = functions.get_coefficients, functions.get_rest_coefficients

    @forward_kernel(module="unique")
    def compute_tangents(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        coefficients: numbers,
        # outputs
        out: wp.array3d(dtype=mat),
    ):
        """Compute dP(H; e_i (x) e_j) of a load case at every point, with index 3 i + j."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            for n in range(9):
                D = mat()
                D[n / 3, n % 3] = scalar(1.0)
                out[e, q, n] = stress_change(H, D, get_coefficients(coefficients, e, q, c))

    @forward_kernel(module="unique")
    def update_max_strain(
        subset: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute s_a = max over points of |H|, at every node of the elements."""
        i, c = wp.tid()
        e, of = subset[i], columns[c]
        most = scalar(0.0)
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, of)
            most = wp.max(most, wp.sqrt(wp.ddot(H, H)))
        for a in range(size if size else sizes[e]):
            wp.atomic_max(out, elements[e, a], c, most)

    @wp.func
    def compute_stiffening(H: mat, k: constants, rest: constants, i: int, j: int):
        """Return dP(H; D) - dP(0; D) for D = e_i (x) e_j."""
        D = mat()
        D[i, j] = scalar(1.0)
        return stress_change(H, D, k) - stress_change(mat(), D, rest)

    # Unrolled, its many stress changes take long to compile.
    @forward_kernel(module="unique", module_options={"max_unroll": 0})
    def add_stiffening(
        subset: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=scalar),
        columns: wp.array(dtype=wp.int32),
        min_strain: wp.array(dtype=scalar),
        index: wp.array2d(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add w grad N_a . (dP(H) - dP(0)) . grad N_b of points with |H| > least to K_ab, at the indices `index`."""
        i, c = wp.tid()
        e, of = subset[i], columns[c]
        nodes = wp.int32(size)
        if nodes == 0:
            nodes = sizes[e]
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, of)
            if wp.sqrt(wp.ddot(H, H)) > min_strain[c]:
                k = get_coefficients(coefficients, e, q, of)
                rest = get_rest_coefficients(k)
                for j in range(3):
                    X = weights[e, q] * compute_stiffening(H, k, rest, j, 0)
                    Y = weights[e, q] * compute_stiffening(H, k, rest, j, 1)
                    Z = weights[e, q] * compute_stiffening(H, k, rest, j, 2)
                    for b in range(nodes):
                        g = gradients[e, q, b]
                        Q = g[0] * X + g[1] * Y + g[2] * Z
                        column = 3 * index[elements[e, b], c] + j
                        for a in range(nodes):
                            f = Q * gradients[e, q, a]
                            row = 3 * index[elements[e, a], c]
                            for m in range(3):
                                wp.atomic_add(out, c, row + m, column, wp.float64(f[m]))

    return StrainKernels(compute_tangents, update_max_strain, add_stiffening)

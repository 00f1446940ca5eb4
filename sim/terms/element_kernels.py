"""Warp kernels over elements: energy, forces, tangent stiffness and step bounds, for any law and element type."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..runtime.device import Device, forward_kernel
from .element_functions import build_functions
from .laws.invariants import cofactor_matrix
from .laws.law import Law

# Minimum J after a step, as a fraction of J before: bounds the logarithm and its second derivative.
MIN_VOLUME_RATIO = 0.1


@dataclass(frozen=True)
class ElementKernels:
    """Kernels over elements with the same law."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    bound_step: wp.Kernel | None
    compute_gradients: wp.Kernel


@cache
def build_broadcast_kernel(device: Device) -> wp.Kernel:
    """Return the kernel that copies the coefficients of each element to all its points and load cases."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def copy_coefficients(
        coefficients: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array4d(dtype=scalar),
    ):
        """Copy coefficients to all points and load cases: n_eqic = k_ei."""
        e, q, i, c = wp.tid()
        out[e, q, i, c] = coefficients[e, i]

    return copy_coefficients


@cache
def build_kernels(law: Law, device: Device, size: int, count: int) -> ElementKernels:
    """Return the kernels for elements with `size` nodes and laws with `count` coefficients.

    Each kernel is launched over (element, load case). If `size` is 0, the array `sizes` has the number of nodes of each
    element. Coefficients are given per element (T,) or, if they vary, per point and load case (T, q, count, b).
    """
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)
    stress, stress_change, density = law.stress, law.stress_change, law.energy
    kept = MIN_VOLUME_RATIO
    functions = build_functions(law, device, size, count)
    compute_gradient, numbers = functions.compute_gradient, functions.array_type
    get_coefficients, get_rest_coefficients = functions.get_coefficients, functions.get_rest_coefficients

    @wp.func
    def add_forces(
        P: mat,
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        e: int,
        q: int,
        c: int,
        out: wp.array2d(dtype=scalar),
    ):
        """Add the element forces f_a += P grad N_a; the sum of these forces is zero."""
        total = vec()
        for a in range(1, size if size else sizes[e]):
            i = 3 * elements[e, a]
            f = P * gradients[e, q, a]
            total += f
            for k in range(3):
                wp.atomic_add(out, i + k, c, f[k])
        i = 3 * elements[e, 0]
        for k in range(3):
            wp.atomic_sub(out, i + k, c, total[k])

    @forward_kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add the energy: E += sum over points of w psi(H)."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            wp.atomic_add(out, c, wp.float64(weights[e, q] * density(H, get_coefficients(coefficients, e, q, c))))

    @forward_kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the internal forces: f_a += sum over points of w P(H) grad N_a."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            P = weights[e, q] * stress(H, get_coefficients(coefficients, e, q, c))
            add_forces(P, sizes, elements, gradients, e, q, c, out)

    @forward_kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add f_a += sum over points of w dP(H; D) grad N_a; `definite` load cases use the undeformed tangent."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            k = get_coefficients(coefficients, e, q, c)
            H = mat()
            if definite[c] == 0:
                H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            else:
                k = get_rest_coefficients(k)
            D = compute_gradient(p, sizes, elements, gradients, e, q, c)
            P = weights[e, q] * stress_change(H, D, k)
            add_forces(P, sizes, elements, gradients, e, q, c, out)

    @wp.func
    def compute_stress_change(H: mat, coefficients: constants, k: int, l: int):
        """Return dP for dF = e_k (x) e_m."""
        D = mat()
        D[k, l] = scalar(1.0)
        return stress_change(H, D, coefficients)

    # Unrolled, its many stress changes take ten seconds to compile.
    @forward_kernel(module="unique", module_options={"max_unroll": 0})
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """Add the diagonal blocks; column j of K_aa is the sum over points of w dP(H; e_j (x) grad N_a) grad N_a.

        Nine stress changes are computed per point and used for all nodes.
        """
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            k = get_coefficients(coefficients, e, q, c)
            H = mat()
            if definite[c] == 0:
                H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            else:
                k = get_rest_coefficients(k)
            for j in range(3):
                X = compute_stress_change(H, k, j, 0)
                Y = compute_stress_change(H, k, j, 1)
                Z = compute_stress_change(H, k, j, 2)
                for a in range(size if size else sizes[e]):
                    g = gradients[e, q, a]
                    f = weights[e, q] * ((g[0] * X + g[1] * Y + g[2] * Z) * g)
                    block = mat()
                    for i in range(3):
                        block[i, j] = f[i]
                    wp.atomic_add(out, elements[e, a], c, block)

    @forward_kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """Halve t until J = det(F + s D) >= kept det F for all s in [0, t]; J is a cubic polynomial of s."""
        e, c = wp.tid()
        one = scalar(1.0)
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            D = compute_gradient(du, sizes, elements, gradients, e, q, c)
            F = wp.identity(n=3, dtype=scalar) + H
            normal, normal_change = cofactor_matrix(F), cofactor_matrix(D)
            a0 = wp.dot(F[0], normal[0])
            a1 = wp.ddot(normal, D)
            a2 = wp.ddot(F, normal_change)
            a3 = wp.dot(D[0], normal_change[0])
            floor = scalar(kept) * a0
            t = out[c]
            zero = scalar(0.0)
            # Fast path: a lower bound of the cubic already exceeds the limit for most steps.
            if a0 + t * (wp.min(a1, zero) + t * (wp.min(a2, zero) + t * wp.min(a3, zero))) >= floor:
                continue
            for _ in range(40):
                low = a0 + t * (a1 + t * (a2 + t * a3))
                # Stationary points of the cubic in (0, t), by the root formula without cancellation.
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

    @forward_kernel(module="unique")
    def compute_gradients(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        # outputs
        out: wp.array3d(dtype=mat),
    ):
        """Compute the displacement gradient H at every point."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            out[e, q, c] = compute_gradient(u, sizes, elements, gradients, e, q, c)

    bounded = bound_step if law.needs_positive_volume else None
    return ElementKernels(add_energy, add_gradient, add_curvature, add_diagonal, bounded, compute_gradients)

"""Warp kernel for the derivative of the elastic forces with respect to the coefficients of a law."""

from functools import cache

import warp as wp

from ..runtime.device import Device, forward_kernel
from .element_functions import build_functions
from .laws.law import Law

STEP = 1e-4  # Step of central differences, relative to the coefficient; exact where the stress is linear in it.


@cache
def build_kernel(law: Law, device: Device, size: int, count: int, own: int) -> wp.Kernel:
    """Return the kernel, launched over (element, load case), for the first `own` of `count` coefficients of a law.

    `size` is the number of nodes of each element, as in `element_kernels.build_kernels`.
    """
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants, stress = wp.types.vector(length=count, dtype=scalar), law.stress
    functions = build_functions(law, device, size, count)
    compute_gradient, get_coefficients = functions.compute_gradient, functions.get_coefficients
    numbers = functions.array_type

    @wp.func
    def compute_work(H: mat, L: mat, coefficients: constants, i: int, change: scalar):
        """Return P(H) : L with coefficient i changed."""
        k = coefficients
        k[i] = k[i] + change
        return wp.ddot(stress(H, k), L)

    @forward_kernel(module="unique", module_options={"max_unroll": 0})
    def add_coefficient_work(
        u: wp.array2d(dtype=scalar),
        v: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=scalar),
        coefficients: numbers,
        # outputs
        out: wp.array3d(dtype=scalar),
    ):
        """Compute the sum over points of w dP(H)/dk_i : grad v, by central differences."""
        e, c = wp.tid()
        for q in range(gradients.shape[1]):
            H = compute_gradient(u, sizes, elements, gradients, e, q, c)
            L = compute_gradient(v, sizes, elements, gradients, e, q, c)
            k = get_coefficients(coefficients, e, q, c)
            for i in range(own):
                step = scalar(STEP) * wp.where(k[i] == scalar(0.0), scalar(1.0), wp.abs(k[i]))
                change = compute_work(H, L, k, i, step) - compute_work(H, L, k, i, -step)
                out[e, i, c] += weights[e, q] * change / (scalar(2.0) * step)

    return add_coefficient_work

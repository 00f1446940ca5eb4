"""Warp functions of all element kernels: displacement gradient of any element, and coefficients of its law."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ..runtime.device import Device
from .laws.law import Law


@dataclass(frozen=True)
class ElementFunctions:
    """Warp functions for displacement gradient and coefficients at a point, undeformed coefficients, and array type."""

    compute_gradient: wp.Function
    get_coefficients: wp.Function
    get_rest_coefficients: wp.Function
    array_type: Any


@cache
def build_functions(law: Law, device: Device, size: int, count: int) -> ElementFunctions:
    """Return the functions for elements with `size` nodes and laws with `count` coefficients; see `build_kernels`."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)

    @wp.func
    def get_element_coefficients(coefficients: wp.array(dtype=constants), e: int, q: int, c: int):
        """Return the coefficients of an element, which are equal at all points and in all load cases."""
        return coefficients[e]

    @wp.func
    def get_point_coefficients(coefficients: wp.array4d(dtype=scalar), e: int, q: int, c: int):
        """Return the coefficients at a point in a load case."""
        k = constants()
        for i in range(count):
            k[i] = coefficients[e, q, i, c]
        return k

    @wp.func
    def return_coefficients(k: constants):
        """Return the coefficients unchanged."""
        return k

    # Loops over nodes are unrolled if `size` is constant, 20 % faster on the CPU; unrolling points as well triples the
    # compile time. Shape gradients sum to zero, so only displacements relative to node 0 count.
    @wp.func
    def compute_gradient(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        e: int,
        q: int,
        c: int,
    ):
        """Return the displacement gradient H = sum over nodes of (u_a - u_0) (x) grad N_a."""
        H = mat()
        i = 3 * elements[e, 0]
        origin = vec(u[i, c], u[i + 1, c], u[i + 2, c])
        for a in range(1, size if size else sizes[e]):
            i = 3 * elements[e, a]
            H += wp.outer(vec(u[i, c], u[i + 1, c], u[i + 2, c]) - origin, gradients[e, q, a])
        return H

    own = wp.array(dtype=constants)
    if law.at_rest is None:
        return ElementFunctions(compute_gradient, get_element_coefficients, return_coefficients, own)
    return ElementFunctions(compute_gradient, get_point_coefficients, law.at_rest, wp.array4d(dtype=scalar))

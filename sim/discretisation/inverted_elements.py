"""Detection of inverted tetrahedra, which make an equilibrium unphysical."""

from functools import cache

import numpy as np
import warp as wp

from ..runtime.device import Device, forward_kernel
from .element import build_linear_elements, build_quadratic_elements
from .space import Discretisation


@cache
def build_kernel(device: Device, size: int, points: int, min_ratio: float) -> wp.Kernel:
    """Return the kernel over (tetrahedron, load case) for tetrahedra of `size` nodes and `points` quadrature points."""
    scalar, vec = device.scalar, device.vector

    @forward_kernel(module="unique")
    def count_inverted(
        u: wp.array2d(dtype=scalar),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        # outputs
        out: wp.array(dtype=wp.int32),
    ):
        """Add 1 to the count if det F <= least at any quadrature point; F = I + sum over nodes of u_a (x) grad N_a."""
        e, c = wp.tid()
        for q in range(points):
            F = wp.identity(n=3, dtype=scalar)
            for a in range(size):
                i = 3 * elements[e, a]
                F += wp.outer(vec(u[i, c], u[i + 1, c], u[i + 2, c]), gradients[e, q, a])
            if wp.determinant(F) <= scalar(min_ratio):
                wp.atomic_add(out, c, 1)
                return

    return count_inverted


class InversionCounter:
    """Counter of tetrahedra that are inverted or collapsed at any quadrature point.

    Linear tetrahedra have one point, quadratic ones eight. Smoothed and element-free strains are averages, but the test
    uses single tetrahedra. A tetrahedron with J below `min_ratio` counts, since the sign of J is then round-off.
    `is_bounded` is True if the energy of the law is infinite for inverted (averaged) deformation gradients.
    """

    def __init__(self, space: Discretisation, device: Device, is_bounded: bool = False, min_ratio: float = 1e-6):
        every, quadratic = np.ones(len(space.mesh.tets), bool), space.element == "p2"
        elements = (
            build_quadratic_elements(space.nodes, space.table, every)
            if quadratic
            else build_linear_elements(space.mesh, every)
        )
        self._telling = not (is_bounded and space.element in ("smoothed", "element-free"))
        self._device, self._collapsed = device, min_ratio
        self._table = device.upload(elements.table, wp.int32)
        self._gradient = device.upload(elements.gradient, device.vector)

    def find_unreliable(self, counts: np.ndarray) -> np.ndarray:
        """Return a mask (B,) of load cases whose inverted tetrahedra, `counts` (B,) > 0, make the equilibrium suspect.

        The mask is False if the law is `bounded` and uses averages: a descent cannot invert the averages, and a strong
        load may invert single tetrahedra for any initial values.
        """
        return self._telling & (counts > 0)

    def count(self, u: wp.array) -> np.ndarray:
        """Return the number (B,) of inverted tetrahedra at the displacements u (3N, B) [m]."""
        out = wp.zeros(u.shape[1], dtype=wp.int32, device=self._device.name)
        self.add_count(u, out)
        return out.numpy()

    def add_count(self, u: wp.array, out: wp.array) -> None:
        """Add the number of inverted tetrahedra at u (3N, B) [m] to out (B,) int32, on the device alone."""
        _, points, size = self._gradient.shape
        inputs = [u, self._table, self._gradient]
        kernel = build_kernel(self._device, size, points, self._collapsed)
        self._device.launch(kernel, (len(self._table), u.shape[1]), inputs, [out])

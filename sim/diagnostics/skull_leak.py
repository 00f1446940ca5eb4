"""How much tissue passes the closed skull: none does in a head."""

from functools import cache

import numpy as np
import warp as wp

from ..anatomy import Anatomy
from ..discretisation.element import quadratic_shapes
from ..discretisation.space import Discretisation
from ..runtime.device import Device, forward_kernel

# Points (6, 3), barycentric, and weights (6,) on a triangle: exact to degree 4 (Dunavant 1985, Table I).
_A, _B = 0.445948490915965, 0.091576213509771
POINTS = np.array([np.roll([1.0 - 2.0 * x, x, x], turn) for x in (_A, _B) for turn in range(3)])
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


def surface_vectors(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The integral (N, 3) [m^2] of N_i n over outward triangles (S, 3) or, quadratic and perhaps curved, (S, 6).

    With N_i a shape function of nodes (N, 3) [m] and n the outward normal it is the integral of grad N_i over the body.
    The sum of its products with displacements is the volume that the surface sweeps. Source: Engelman, Sani, Gresho
    1982, Int. J. Numer. Methods Fluids 2:225-238.
    """
    out = np.zeros_like(nodes)
    for at, weight in zip(POINTS, WEIGHTS, strict=True):
        shape, slope = at, np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        if triangles.shape[1] == 6:  # corners, then the middles of the edges between corners 0 and 1, 1 and 2, 2 and 0
            i, j = ends = np.array([(0, 1, 2), (1, 2, 0)])
            shape = quadratic_shapes(at, ends.T)
            middles = 4.0 * (at[i, None] * slope[j] + at[j, None] * slope[i])
            slope = np.vstack([(4.0 * at - 1.0)[:, None] * slope, middles])
        tangents = np.einsum("ski,kd->sdi", nodes[triangles], slope)
        normal = 0.5 * weight * np.cross(tangents[:, 0], tangents[:, 1])
        for k, share in enumerate(shape):
            np.add.at(out, triangles[:, k], share * normal)
    return out


@cache
def kernel_of(device: Device) -> wp.Kernel:
    """The kernel of a device's scalar type, over (surface node, column)."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def sweep(
        u: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        vector: wp.array(dtype=wp.vec3d),
        covered: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """v = a_i . u_i; out_0 += max(v, 0) where a skull covers node i, out_1 += |v| where none does."""
        s, c = wp.tid()
        v = wp.float64(0.0)
        for k in range(3):
            v += vector[s][k] * wp.float64(u[3 * nodes[s] + k, c])
        if covered[s] == 0:
            wp.atomic_add(out, 1, c, wp.abs(v))
        elif v > wp.float64(0.0):
            wp.atomic_add(out, 0, c, v)

    return sweep


class Leak:
    """The volume that passes out through the closed skull, as a share of what the opening takes in and gives out."""

    def __init__(self, anatomy: Anatomy, space: Discretisation, device: Device):
        vectors = surface_vectors(space.nodes, space.surface)
        nodes = np.flatnonzero(vectors.any(axis=1))
        normal = space.sliding(anatomy.slide_normal, anatomy.held)
        covered = (normal != 0.0).any(axis=1) | space.held(anatomy.held).all(axis=1)
        self._device = device
        self._nodes = device.array(nodes, wp.int32)
        self._vectors = device.array(vectors[nodes], wp.vec3d)
        self._covered = device.array(covered[nodes].astype(np.int32), wp.int32)

    def share(self, u: wp.array) -> np.ndarray:
        """Of u (3N, B) [m] on the device: (B,), zero where nothing passes, NaN of what passes where nothing is open."""
        out = wp.zeros((2, u.shape[1]), dtype=wp.float64, device=self._device.name)
        inputs = [u, self._nodes, self._vectors, self._covered]
        self._device.launch(kernel_of(self._device), (len(self._nodes), u.shape[1]), inputs, [out])
        passed, swept = out.numpy()
        return np.divide(passed, swept, out=np.where(passed > 0.0, np.nan, 0.0), where=swept > 0.0)

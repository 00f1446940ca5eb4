"""Volume of tissue that passes the closed skull: zero in a real head."""

from functools import cache

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ..anatomy import Anatomy
from ..discretisation.element import compute_quadratic_shapes
from ..discretisation.space import Discretisation
from ..geometry.surface import compute_areas
from ..runtime.device import Device, forward_kernel

# Points (6, 3), barycentric, and weights (6,) on a triangle: exact to degree 4 (Dunavant 1985, Table I).
_A, _B = 0.445948490915965, 0.091576213509771
POINTS = np.array([np.roll([1.0 - 2.0 * x, x, x], turn) for x in (_A, _B) for turn in range(3)])
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


def integrate_facet_normals(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the integrals of N_i n, (S, k, 3) [m^2], over outward triangles (S, k): k = 3 or, if quadratic, k = 6.

    N_i is the shape function of node i, `nodes` (N, 3) [m], and n is the outward normal. The sum of the products with
    the displacements of the nodes is the volume that the triangle sweeps.

    Engelman, Sani, Gresho 1982, "The implementation of normal and/or tangential boundary conditions in finite element
    codes for incompressible fluid flow", Int. J. Numer. Methods Fluids 2:225-238.
    """
    out = np.zeros((*triangles.shape, 3))
    for at, weight in zip(POINTS, WEIGHTS, strict=True):
        shape, slope = at, np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        if triangles.shape[1] == 6:  # corners, then the middles of the edges between corners 0 and 1, 1 and 2, 2 and 0
            i, j = ends = np.array([(0, 1, 2), (1, 2, 0)])
            shape = compute_quadratic_shapes(at, ends.T)
            middles = 4.0 * (at[i, None] * slope[j] + at[j, None] * slope[i])
            slope = np.vstack([(4.0 * at - 1.0)[:, None] * slope, middles])
        tangents = np.einsum("ski,kd->sdi", nodes[triangles], slope)
        out += shape[:, None] * (0.5 * weight * np.cross(tangents[:, 0], tangents[:, 1]))[:, None]
    return out


@cache
def build_kernel(device: Device) -> wp.Kernel:
    """Return the kernel over (patch, load case), for the scalar type of the device."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def add_swept_volume(
        u: wp.array2d(dtype=scalar),
        patch_start: wp.array(dtype=wp.int32),
        nodes: wp.array(dtype=wp.int32),
        vectors: wp.array(dtype=wp.vec3d),
        is_covered: wp.array(dtype=wp.int32),
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Compute v = sum a_i . u_i of a patch; add max(v, 0) to out_0 if skull covers the patch, else |v| to out_1."""
        s, c = wp.tid()
        v = wp.float64(0.0)
        for i in range(patch_start[s], patch_start[s + 1]):
            for k in range(3):
                v += vectors[i][k] * wp.float64(u[3 * nodes[i] + k, c])
        if is_covered[s] == 0:
            wp.atomic_add(out, 1, c, wp.abs(v))
        elif v > wp.float64(0.0):
            wp.atomic_add(out, 0, c, v)

    return add_swept_volume


class SkullLeak:
    """Tissue volume that passes outwards through the closed skull, relative to the volume swept by the open surface.

    The flux through each covered facet is averaged over all facets within `radius` [m], the size of a palpating tool.
    Sums over the facets of one node would not show a leak: for a node that slides perpendicular to the mean normal of
    its facets, this sum is zero by construction.
    """

    def __init__(self, anatomy: Anatomy, space: Discretisation, device: Device, radius: float = 7e-3):
        solid = (anatomy.slide_normal != 0.0).any(axis=1) | anatomy.fixed.all(axis=1)
        covered = solid[space.mesh.surface].all(axis=1)
        vectors = integrate_facet_normals(space.nodes, space.surface)
        corners = space.nodes[space.surface[:, :3]]
        near = KDTree(corners.mean(axis=1)).query_ball_point(corners.mean(axis=1), radius)
        size = compute_areas(corners)
        patches = [
            np.array([row]) if not covered[row] else np.array(some)[covered[some]] for row, some in enumerate(near)
        ]
        row, other = np.repeat(np.arange(len(size)), [len(patch) for patch in patches]), np.concatenate(patches)
        mean = size[row] / np.bincount(row, size[other])[row]
        key = (row[:, None] * space.count + space.surface[other]).ravel()
        key, place = np.unique(key, return_inverse=True)
        lent = (mean[:, None, None] * vectors[other]).reshape(-1, 3)
        total = np.column_stack([np.bincount(place, lent[:, k]) for k in range(3)])
        self._device = device
        self._arrays = [
            device.upload(np.searchsorted(key, space.count * np.arange(len(size) + 1)), wp.int32),
            device.upload(key % space.count, wp.int32),
            device.upload(total, wp.vec3d),
            device.upload(covered.astype(np.int32), wp.int32),
        ]

    def compute_fraction(self, u: wp.array) -> np.ndarray:
        """Return the relative leak (B,) at u (3N, B) [m]; 0 without a leak, NaN without an open surface."""
        out = wp.zeros((2, u.shape[1]), dtype=wp.float64, device=self._device.name)
        self._device.launch(build_kernel(self._device), (len(self._arrays[3]), u.shape[1]), [u, *self._arrays], [out])
        passed, swept = out.numpy()
        return np.divide(passed, swept, out=np.where(passed > 0.0, np.nan, 0.0), where=swept > 0.0)

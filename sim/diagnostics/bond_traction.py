"""Traction on the bond between brain and skull, relative to the strength of the bond."""

from functools import cache

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ..anatomy import Anatomy
from ..discretisation.space import Discretisation
from ..effects import Bonded
from ..geometry.surface import compute_areas
from ..runtime.device import Device, forward_kernel


@cache
def build_kernel(device: Device) -> wp.Kernel:
    """Return the kernel over (patch, load case), for the scalar type of the device."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def compute_ratios(
        force: wp.array2d(dtype=scalar),
        patch_start: wp.array(dtype=wp.int32),
        nodes: wp.array(dtype=wp.int32),
        normal: wp.array(dtype=wp.vec3d),
        area: wp.array(dtype=wp.float64),
        tension: wp.float64,
        shear: wp.float64,
        # outputs
        ratios: wp.array2d(dtype=wp.float64),
        max_ratio: wp.array(dtype=wp.float64),
    ):
        """Compute s = |(max(t.n, 0) / tension, (t - (t.n) n) / shear)| per patch, t = force / area, and max(s)."""
        p, c = wp.tid()
        t = wp.vec3d()
        for k in range(patch_start[p], patch_start[p + 1]):
            for i in range(3):
                t[i] += wp.float64(force[3 * nodes[k] + i, c])
        t /= area[p]
        pull = wp.dot(t, normal[p])
        along = wp.length(t - pull * normal[p]) / shear
        s = wp.sqrt(wp.pow(wp.max(pull, wp.float64(0.0)) / tension, wp.float64(2.0)) + along * along)
        wp.atomic_max(max_ratio, c, s)
        if ratios:
            ratios[p, c] = s

    return compute_ratios


class BondTraction:
    """Traction between brain and skull, relative to the strengths in `Bonded`.

    Tension and shear are combined as sqrt((t_n / tension)^2 + (t_s / shear)^2): the quadratic nominal stress criterion
    of cohesive layers (Camanho, Davila 2002, NASA/TM-2002-211737, eq. 16). Pressure never breaks the bond. Tractions
    are averaged over a `radius` [m] of each node, since tractions are singular at the edge of a craniotomy, but
    averages are not.
    """

    def __init__(self, effect: Bonded, anatomy: Anatomy, space: Discretisation, device: Device, radius: float = 5e-3):
        self._effect, self._device = effect, device
        covered, corners = (anatomy.slide_normal != 0.0).any(axis=1), space.mesh.surface
        wall = (covered | anatomy.fixed.all(axis=1))[corners].all(axis=1) & covered[corners].any(axis=1)
        triangles = space.surface[wall]
        share = np.repeat(compute_areas(space.nodes[triangles[:, :3]])[:, None] / 3.0, 3, axis=1)
        # For quadratic triangles, the integrals of the corners' shape functions are zero.
        area = np.bincount(triangles[:, -3:].ravel(), share.ravel(), space.count)
        nodes = np.unique(triangles)
        near = KDTree(space.nodes[nodes]).query_ball_point(space.nodes[nodes], radius)
        normal = space.extend_normals(anatomy.slide_normal, anatomy.fixed)[nodes]
        kept = np.flatnonzero(normal.any(axis=1) & np.array([area[nodes[patch]].any() for patch in near], bool))
        patches = [nodes[near[patch]] for patch in kept]
        self.nodes = nodes[kept]
        self._arrays = [
            device.upload(np.cumsum([0, *map(len, patches)]), wp.int32),
            device.upload(np.concatenate([np.zeros(0, np.int64), *patches]), wp.int32),
            device.upload(normal[kept], wp.vec3d),
            device.upload(np.array([area[patch].sum() for patch in patches]), wp.float64),
        ]

    def compute_ratios(self, force: wp.array) -> np.ndarray:
        """Return the relative traction (n, B) at `nodes` (n,), from the forces (3N, B) [N] of skull on brain."""
        share = wp.zeros((len(self.nodes), force.shape[1]), dtype=wp.float64, device=self._device.name)
        self._compute_largest_ratio(force, share)
        return share.numpy()

    def compute_max_ratio(self, force: wp.array) -> np.ndarray:
        """Return the largest relative traction (B,); above 1 the bond would fail. NaN without a skull."""
        return self._compute_largest_ratio(force).numpy() if len(self.nodes) else np.full(force.shape[1], np.nan)

    def _compute_largest_ratio(self, force: wp.array, ratios: wp.array | None = None) -> wp.array:
        """Return the largest relative traction (B,) of each load case, as a device array.

        If `ratios` is given, the relative tractions (n, B) of all nodes are written to this array.
        """
        most = wp.zeros(force.shape[1], dtype=wp.float64, device=self._device.name)
        inputs = [force, *self._arrays, wp.float64(self._effect.tension), wp.float64(self._effect.shear)]
        self._device.launch(build_kernel(self._device), (len(self.nodes), force.shape[1]), inputs, [ratios, most])
        return most

"""Dead loads, whose magnitude and direction do not change with deformation: nodal forces, and footprint tractions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ..discretisation.footprint import ContactSurface
from ..discretisation.term import Cases
from ..loads import Loads, Nodal, Pushed, check_field
from ..runtime.columns import CHUNK, gather_columns
from ..runtime.device import Device, forward_kernel


@dataclass(frozen=True)
class DeadForceKernels:
    """Kernels over loaded nodes, for one scalar type."""

    distribute: wp.Kernel
    subtract_forces: wp.Kernel
    subtract_work: wp.Kernel


@cache
def build_kernels(device: Device) -> DeadForceKernels:
    """Return the kernels for the scalar type of a device."""
    scalar = device.scalar
    chunk = CHUNK

    @forward_kernel(module="unique")
    def distribute(
        weights: wp.array2d(dtype=wp.float64),
        sums: wp.array(dtype=wp.vec4d),
        tool_forces: wp.array2d(dtype=wp.float64),
        # outputs
        force: wp.array2d(dtype=scalar),
    ):
        """Distribute tool forces F by footprint weights w: f_(3i+k)c += w_ic / (sum of w)_c F_ck."""
        i, c = wp.tid()
        for k in range(3):
            force[3 * i + k, c] += scalar(weights[i, c] / sums[c][0] * tool_forces[c, k])

    @forward_kernel(module="unique")
    def subtract_forces(
        nodes: wp.array(dtype=wp.int32),
        force: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Subtract the nodal forces from the gradient: g -= f."""
        i, c = wp.tid()
        for k in range(3):
            out[3 * nodes[i] + k, c] -= force[3 * i + k, c]

    @forward_kernel(module="unique")
    def subtract_work(
        nodes: wp.array(dtype=wp.int32),
        force: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Subtract the work in double precision: E_c -= sum over a chunk of nodes of f . u."""
        block, c = wp.tid()
        total = wp.float64(0.0)
        for i in range(block * chunk, wp.min((block + 1) * chunk, nodes.shape[0])):
            for k in range(3):
                total += wp.float64(force[3 * i + k, c]) * wp.float64(u[3 * nodes[i] + k, c])
        wp.atomic_sub(out, c, total)

    return DeadForceKernels(distribute, subtract_forces, subtract_work)


@dataclass(frozen=True, eq=False)
class NodalForces:
    """Nodal forces on the device: unique `nodes` (k,) int32, and `force` (3k, b) [N]."""

    nodes: wp.array
    force: wp.array


def build_pushed_forces(surface: ContactSurface, device: Device, loads: Loads) -> NodalForces | None:
    """Return the nodal forces of pushing tools on a surface, or None if no tool pushes.

    Raises
    ------
    InputError
        A footprint does not touch the surface.
    """
    causes = loads.get_all(Pushed)
    if not causes:
        return None
    force = device.allocate(3 * len(surface.nodes), len(loads))
    for cause in causes:
        footprints = surface.find_footprints(cause.point, cause.footprint)
        inputs = [footprints.weight, footprints.sums, device.upload(cause.force, wp.float64)]
        device.launch(build_kernels(device).distribute, footprints.weight.shape, inputs, [force])
    return NodalForces(surface.numbers, force)


def build_nodal_forces(vertex_count: int, device: Device, loads: Loads) -> NodalForces | None:
    """Return the forces prescribed at mesh vertices, only at loaded vertices; None without `Nodal` loads.

    Raises
    ------
    InputError
        The number of vertices differs from that of the mesh.
    """
    cause = loads.get(Nodal)
    if cause is None:
        return None
    check_field("Nodal.force", cause.force, vertex_count)
    nodes = np.flatnonzero(cause.force.any(axis=(0, 2)))
    force = cause.force[:, nodes].reshape(len(loads), 3 * len(nodes)).T
    return NodalForces(device.upload(nodes, wp.int32), device.upload(force))


class DeadForce:
    """Energy term of dead loads: E = -f . u, with forces f assembled from the loads once per batch.

    Parameters
    ----------
    name
        Unique name in the problem.
    assemble
        Function that returns the `NodalForces` of loads, or None without forces; then no kernel is launched.
    device
        Device of the arrays.
    """

    constant, passive, steep = True, False, False

    def __init__(self, name: str, assemble: Callable[[Loads], NodalForces | None], device: Device):
        self.name = name
        self._assemble = assemble
        self._device = device
        self._forces: NodalForces | None = None

    def begin(self, cases: Cases) -> None:
        """Assemble the nodal forces of every load case."""
        self.set_forces(self._assemble(cases.loads))

    def set_forces(self, forces: NodalForces | None) -> None:
        """Set the nodal forces of the batch."""
        self._forces = forces

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the forces of the load cases `columns`."""
        if self._forces is not None:
            self._forces = NodalForces(self._forces.nodes, gather_columns(self._device, self._forces.force, columns))

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy: E -= f . u."""
        if self._forces is not None:
            dim = (-(-len(self._forces.nodes) // CHUNK), u.shape[1])
            inputs = [self._forces.nodes, self._forces.force, u]
            self._device.launch(build_kernels(self._device).subtract_work, dim, inputs, [out])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient: g -= f."""
        if self._forces is not None:
            dim = (len(self._forces.nodes), u.shape[1])
            inputs = [self._forces.nodes, self._forces.force]
            self._device.launch(build_kernels(self._device).subtract_forces, dim, inputs, [out])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Do nothing: a dead load has no tangent stiffness."""

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Do nothing: a dead load has no tangent stiffness."""

    def add_diagonal(self, out: wp.array) -> None:
        """Do nothing: a dead load has no tangent stiffness."""

    def rest_curvature(self) -> None:
        """Return None: a dead load has no tangent stiffness."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Do nothing, since a dead load does not limit the step."""

    def end(self, u: wp.array) -> None:
        """Return None: a dead load has no history."""

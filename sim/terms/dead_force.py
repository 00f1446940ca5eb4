"""Forces that keep size and direction while the tissue moves: nodal forces, and tractions on a footprint."""

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
    """Arithmetic on the loaded nodes in one scalar type."""

    spread: wp.Kernel
    subtract: wp.Kernel
    subtract_work: wp.Kernel


@cache
def build_kernels(device: Device) -> DeadForceKernels:
    """Kernels of a device's scalar type."""
    scalar = device.scalar
    chunk = CHUNK

    @forward_kernel(module="unique")
    def spread(
        weight: wp.array2d(dtype=wp.float64),
        sums: wp.array(dtype=wp.vec4d),
        whole: wp.array2d(dtype=wp.float64),
        # outputs
        force: wp.array2d(dtype=scalar),
    ):
        """f_(3i+k)c += w_ic / (sum of w)_c F_ck."""
        i, c = wp.tid()
        for k in range(3):
            force[3 * i + k, c] += scalar(weight[i, c] / sums[c][0] * whole[c, k])

    @forward_kernel(module="unique")
    def subtract(
        nodes: wp.array(dtype=wp.int32),
        force: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """g -= f."""
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
        """E_c -= sum over a chunk of nodes of f . u, in double precision."""
        block, c = wp.tid()
        total = wp.float64(0.0)
        for i in range(block * chunk, wp.min((block + 1) * chunk, nodes.shape[0])):
            for k in range(3):
                total += wp.float64(force[3 * i + k, c]) * wp.float64(u[3 * nodes[i] + k, c])
        wp.atomic_sub(out, c, total)

    return DeadForceKernels(spread, subtract, subtract_work)


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces on k nodes, on the device: nodes (k,) int32, each once, and force (3k, b) [N]."""

    nodes: wp.array
    force: wp.array


def build_pushed_forces(skin: ContactSurface, device: Device, loads: Loads) -> Forces | None:
    """Nodal forces of pushing tools on a body's surface; None without any.

    Raises
    ------
    InputError
        A footprint that does not touch the surface.
    """
    causes = loads.every(Pushed)
    if not causes:
        return None
    force = device.zeros(3 * len(skin.nodes), len(loads))
    for cause in causes:
        footprints = skin.press(cause.point, cause.footprint)
        inputs = [footprints.weight, footprints.sums, device.array(cause.force, wp.float64)]
        device.launch(build_kernels(device).spread, footprints.weight.shape, inputs, [force])
    return Forces(skin.numbers, force)


def build_nodal_forces(vertices: int, device: Device, loads: Loads) -> Forces | None:
    """Return forces given at a mesh's own vertices, of those that carry any; None without any.

    Raises
    ------
    InputError
        Forces of another mesh.
    """
    cause = loads.of(Nodal)
    if cause is None:
        return None
    check_field("Nodal.force", cause.force, vertices)
    nodes = np.flatnonzero(cause.force.any(axis=(0, 2)))
    force = cause.force[:, nodes].reshape(len(loads), 3 * len(nodes)).T
    return Forces(device.array(nodes, wp.int32), device.array(force))


class DeadForce:
    """A Term: E = -f . u, with f assembled from the loads once a batch.

    Parameters
    ----------
    name
        Unique in its problem.
    assemble
        Loads -> `Forces`, or None where nothing acts: then nothing is launched.
    device
        Where its arrays live.
    """

    constant, passive, steep = True, False, False

    def __init__(self, name: str, assemble: Callable[[Loads], Forces | None], device: Device):
        self.name = name
        self._assemble = assemble
        self._device = device
        self._forces: Forces | None = None

    def begin(self, cases: Cases) -> None:
        """Assemble the nodal forces of every column."""
        self.take(self._assemble(cases.loads))

    def take(self, forces: Forces | None) -> None:
        """These forces act on the batch."""
        self._forces = forces

    def keep(self, columns: np.ndarray) -> None:
        """Drop the forces of the others."""
        if self._forces is not None:
            self._forces = Forces(self._forces.nodes, gather_columns(self._device, self._forces.force, columns))

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E -= f . u."""
        if self._forces is not None:
            dim = (-(-len(self._forces.nodes) // CHUNK), u.shape[1])
            inputs = [self._forces.nodes, self._forces.force, u]
            self._device.launch(build_kernels(self._device).subtract_work, dim, inputs, [out])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """g -= f."""
        if self._forces is not None:
            dim = (len(self._forces.nodes), u.shape[1])
            inputs = [self._forces.nodes, self._forces.force]
            self._device.launch(build_kernels(self._device).subtract, dim, inputs, [out])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """A dead force has no curvature."""

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """A dead force has no curvature."""

    def add_diagonal(self, out: wp.array) -> None:
        """A dead force has no curvature."""

    def rest_curvature(self) -> None:
        """A dead force has no curvature."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """A dead force allows every step."""

    def end(self, u: wp.array) -> None:
        """A dead force remembers nothing."""
